"""A comparison's files hold the same errors as the figures that are printed."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image
from scipy.spatial.transform import Rotation

from pipeline.cli import voxscene
from pipeline.errors import PipelineError
from pipeline.evaluation.error_files import write_comparison
from pipeline.evaluation.trajectories import ComparedTrajectory, compared_file, compared_run, peer_runs
from pipeline.fingerprints import file_hash
from pipeline.peers import registry
from pipeline.publishing.trajectory_files import tum_lines
from pipeline.run_access import open_run_folder
from pipeline.views.error_view import write_error_rrd
from recordings.types import CameraIntrinsics, Trajectory
from slam.result import SlamResult


def positions(path: Path) -> np.ndarray:
    """Positions (n, 3) of a TUM file."""
    return np.loadtxt(path)[:, 1:4]


def aligned_error_m(estimate: np.ndarray, reference: np.ndarray) -> float:
    """Root mean square distance after the best rigid motion, found by search over many (no closed form)."""
    from scipy.optimize import least_squares

    def apart(motion: np.ndarray) -> np.ndarray:
        return (Rotation.from_rotvec(motion[:3]).apply(estimate) + motion[3:] - reference).ravel()

    return float(np.sqrt((least_squares(apart, np.zeros(6)).fun.reshape(-1, 3) ** 2).sum(1).mean()))


@pytest.fixture
def reference(true_trajectory: SlamResult, seed: int) -> Trajectory:
    """The estimate with errors of a centimetre, in another frame, and one frame missing."""
    rng = np.random.default_rng(seed)
    poses = true_trajectory.mean.copy()
    poses[:, :3, 3] += rng.normal(0, 0.01, (len(poses), 3))
    elsewhere = np.eye(4)
    elsewhere[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    elsewhere[:3, 3] = [1, 2, 3]
    return Trajectory(
        times_ns=np.delete(true_trajectory.times_ns, 1),
        reference_from_camera=np.delete(elsewhere @ poses, 1, axis=0),
    )


def test_files_and_figures_agree(true_trajectory: SlamResult, reference: Trajectory, tmp_path: Path) -> None:
    """TUM files by an independent alignment, the table's root mean square, and somebody else's file."""
    ours = compared_run(true_trajectory, reference)
    text = tum_lines(true_trajectory.times_ns, true_trajectory.mean)
    (tmp_path / "their.tum").write_text(text, encoding="utf-8-sig", newline="\r\n")  # of Windows
    theirs = compared_file(tmp_path / "their.tum", reference)
    assert theirs.errors.ate_m == pytest.approx(ours.errors.ate_m, abs=1e-8)

    out = tmp_path / "cmp"
    written = write_comparison(out, true_trajectory, ours, [theirs])
    assert all(path.is_file() for path in written)
    left, right = positions(out / "estimate.tum"), positions(out / "reference.tum")
    assert len(left) == len(right) == len(true_trajectory) - 1
    assert aligned_error_m(left @ np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]), right) == pytest.approx(
        ours.errors.ate_m, abs=1e-6
    )
    with (out / "errors.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frame"]) for row in rows] == [0, 2, 3, 4, 5]
    squares = [float(row["position_error_m"]) ** 2 for row in rows]
    assert np.sqrt(np.mean(squares)) == pytest.approx(ours.errors.ate_m, abs=1e-8)
    for name in ("error.png", "path.png"):
        with Image.open(out / name) as picture:
            assert picture.width > 300


def test_stamps_are_those_of_the_frames_and_of_others_files(
    true_trajectory: SlamResult, reference: Trajectory, tmp_path: Path
) -> None:
    """Digit by digit: as floating-point numbers stamps of today are off by up to 120 ns, and join nothing."""
    today_ns = 1_700_000_000_123_456_789
    result = replace(true_trajectory, times_ns=true_trajectory.times_ns + today_ns)
    truth = replace(reference, times_ns=reference.times_ns + today_ns)
    text = tum_lines(result.times_ns, result.mean)
    (tmp_path / "their.tum").write_text(text)
    theirs = compared_file(tmp_path / "their.tum", truth)
    write_comparison(tmp_path, result, compared_run(result, truth), [theirs])

    stamps = [line.split()[0] for line in text.splitlines()]
    written = (tmp_path / "estimate.their.tum").read_text().splitlines()
    assert [line.split()[0] for line in written] == stamps[:1] + stamps[2:]
    with (tmp_path / "errors.csv").open() as file:
        assert [row["time_s"] for row in csv.DictReader(file)] == stamps[:1] + stamps[2:]


def test_rotation_errors_along_a_straight_path_are_those_of_rotations(
    true_trajectory: SlamResult, seed: int, tmp_path: Path
) -> None:
    """Tenths of a millimetre across the path would turn the aligned estimate about it by any angle."""
    rng = np.random.default_rng(seed)
    count = len(true_trajectory)
    truth = np.tile(np.eye(4), (count, 1, 1))
    truth[:, 0, 3] = 0.1 * np.arange(count)
    estimate = truth.copy()
    estimate[:, :3, 3] += rng.normal(0, 1e-4, (count, 3))
    elsewhere = np.eye(4)
    elsewhere[:3, :3] = Rotation.random(rng=rng).as_matrix()
    estimate[2, :3, :3] = Rotation.from_rotvec([0, 0, 0.06]).as_matrix()
    result = replace(true_trajectory, mean=elsewhere @ estimate)
    reference = Trajectory(times_ns=result.times_ns, reference_from_camera=truth)
    write_comparison(tmp_path, result, compared_run(result, reference), [])
    with (tmp_path / "errors.csv").open() as file:
        found = [float(row["rotation_error_rad"]) for row in csv.DictReader(file)]

    expected = np.full(count, 0.06 / count)
    expected[2] = 0.06 - 0.06 / count
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_views_of_errors_are_whole_or_not_at_all(
    true_trajectory: SlamResult, reference: Trajectory, tmp_path: Path, limited_files
) -> None:
    """On a full disk, one line and no file."""
    ours = compared_run(true_trajectory, reference)
    path = tmp_path / "errors.rrd"
    with pytest.raises(PipelineError, match="File too large"), limited_files(2000):
        write_error_rrd(path, [ours])
    assert not list(tmp_path.iterdir())
    write_error_rrd(path, [ours])
    assert path.stat().st_size > 2000


def test_a_peer_that_leaves_the_numbers_is_lost(
    true_trajectory: SlamResult, reference: Trajectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With that setting; with all of them it is told why."""
    ours = compared_run(true_trajectory, reference)
    away = ours.reference.copy()
    away[1, :3, 3] = np.nan
    settings = {"away": lambda *_: away, "right": lambda *_: ours.reference}
    monkeypatch.setattr(
        registry, "settings_of", lambda name: settings if name == "peer" else {"away": settings["away"]}
    )
    camera = CameraIntrinsics(width=8, height=6, fx=8.0, fy=8.0, cx=3.5, cy=2.5)
    found = peer_runs(["peer", "other"], [], camera, ours, lambda *_: None)

    assert found["other"] == "its poses are not finite"
    assert isinstance(found["peer"], ComparedTrajectory)
    assert found["peer"].name == "right"


def test_a_file_that_is_no_trajectory_is_told(reference: Trajectory, tmp_path: Path) -> None:
    """In one line that names it, without a warning of NumPy's."""
    for text, why in (
        ("hello\n", ""),
        ("", "each line needs"),
        ("1 0 0 0 0 0 0 1\n2 0 nan 0 0 0 0 1\n", "pose 2 is not finite"),
        ("1403636579758555392 0 0 0 0 0 0 1\n", "1403636579758555392 is no time in seconds"),
    ):
        (tmp_path / "their.tum").write_text(text)
        with pytest.raises(PipelineError, match=rf"their\.tum is not a TUM trajectory.*{why}"):
            compared_file(tmp_path / "their.tum", reference)


@pytest.mark.parametrize("against", ["a/orb.tum,b/orb.txt", "voxscene.tum", "out/reference.tum"])
def test_two_trajectories_of_one_name_are_refused(
    against: str, mug_file: Path, true_trajectory: SlamResult, tmp_path: Path
) -> None:
    """In one line: one's file and line would stand for the other's."""
    with open_run_folder(tmp_path, {mug_file.name: "hash"}) as run:
        run.stage("slam", SlamResult.load, lambda: true_trajectory, settings={}, inputs={})
    command = ["eval", "slam", str(tmp_path), "--reference", str(mug_file), "--against", against]
    result = CliRunner().invoke(voxscene, command)

    assert (result.exit_code, result.stderr.count("\n")) == (1, 1), result.output
    assert "two trajectories are named" in result.stderr


def test_another_table_is_not_replaced(mug_file: Path, true_trajectory: SlamResult, tmp_path: Path) -> None:
    """An errors.csv of somebody else stays, told in one line; one of an earlier comparison does not."""
    with open_run_folder(tmp_path / "run", {mug_file.name: file_hash(mug_file)}) as run:
        run.stage("slam", SlamResult.load, lambda: true_trajectory, settings={}, inputs={})
    out = tmp_path / "our out"
    command = ["eval", "slam", str(tmp_path / "run"), "--reference", str(mug_file), "-o", str(out)]
    for _ in range(2):
        result = CliRunner().invoke(voxscene, command)
        assert result.exit_code == 0, result.output
        assert f"evo_ape tum '{out}/reference.tum' '{out}/estimate.tum'" in result.stdout
    (out / "errors.csv").write_text("name,error\n")
    result = CliRunner().invoke(voxscene, command)

    assert (result.exit_code, result.stderr.count("\n")) == (1, 1)
    assert "errors.csv: it is there and is no table of eval slam" in result.stderr
    assert (out / "errors.csv").read_text() == "name,error\n"
