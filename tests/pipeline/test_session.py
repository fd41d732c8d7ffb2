"""A command's stages depend on the recording, its reading, the seed and the settings, and end in files."""

import json
import os
import shutil
import tomllib
from pathlib import Path

import click
import jax
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from pipeline.cli import Failure, voxscene
from pipeline.config import Settings
from pipeline.errors import PipelineError
from pipeline.options import Common, RecordingSource, common_options, recording_options
from pipeline.publishing.publish import stage_document
from pipeline.seeds import STAGES
from pipeline.session import Session, open_session
from recordings.sensor_profile import read_sensor_profile
from slam.config import SlamConfig
from slam.result import SlamResult


def common(seed: int = 0, overrides: tuple[str, ...] = ()) -> Common:
    """A quiet command."""
    settings = Settings.read(None, (*overrides, f"run.seed={seed}"))
    return Common(as_json=False, quiet=True, settings=settings)


class Tracker:
    """Counts how often it is asked for the trajectory."""

    def __init__(self, result: SlamResult) -> None:
        self.times = 0
        self._result = result

    def __call__(self) -> SlamResult:
        """The trajectory."""
        self.times += 1
        return self._result

    def stage(self, session: Session, config: SlamConfig) -> SlamResult:
        """The stage slam of a session."""
        return session.stage("slam", SlamResult.load, self, {"slam": config}).value


def track(tracker: Tracker, recording: Path, run: Path, seed: int = 0, every: int | None = None) -> Session:
    """One command's work."""
    source = RecordingSource(path=recording, said={"every": every})
    with open_session(common(seed), source, run) as session:
        tracker.stage(session, SlamConfig(particles=3))
    return session


def path_length_m(result: SlamResult) -> float:
    """How far the camera went."""
    steps = result.mean[1:, :3, 3] - result.mean[:-1, :3, 3]
    return float(sum(np.sqrt((step**2).sum()) for step in steps))


def test_a_stage_runs_again_for_another_seed_or_reading(
    mug_file: Path, true_trajectory: SlamResult, tmp_path: Path
) -> None:
    """And not otherwise."""
    tracker = Tracker(true_trajectory)
    for count, (seed, every) in enumerate([(0, None), (1, None), (1, 2)], start=1):
        for _ in range(2):
            track(tracker, mug_file, tmp_path / "run", seed, every)
        assert tracker.times == count


def test_stages_of_one_run_are_of_the_same_frames(
    mug_file: Path, true_trajectory: SlamResult, tmp_path: Path
) -> None:
    """Frames are known by number: others are refused in one line, made anew, or removed with force."""
    run = tmp_path / "run"
    track(Tracker(true_trajectory), mug_file, run, every=3)

    def begin(*names: str, force: bool = False, **reading: object) -> list[str]:
        source = RecordingSource(path=mug_file, said=reading)
        with open_session(common(), source, run, force=force) as session:
            session.begin(*names)
            return list(session.run.records())

    with pytest.raises(PipelineError, match=r"slam of other frames .*every 3 there, 1 here.*--force") as told:
        begin("parse")
    assert "\n" not in str(told.value)
    for command in (["parse", "--shapes", str(tmp_path)], ["learn", "--name", "mug", "--poses", "recorded"]):
        result = CliRunner().invoke(voxscene, [*command, str(mug_file), "-o", str(run), "-q"])
        assert (result.exit_code, "slam of other frames" in result.stderr) == (1, True), result.output
    assert begin("slam") == begin("parse", "slam") == begin("parse", every=3, max_depth_m=4.0) == ["slam"]
    assert begin("parse", force=True) == []
    assert not (run / "slam.npz").exists()


def test_files_of_reading_count_by_what_they_hold(
    mug_file: Path, true_trajectory: SlamResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Under another path nothing is computed again, with another content it is; any folder finds them."""
    monkeypatch.chdir(tmp_path)
    mask, tracker = np.full((72, 96), 255, np.uint8), Tracker(true_trajectory)
    for name, left in (("a.png", 0), ("b.png", 0), ("c.png", 9)):
        mask[:, :left] = 0
        Image.fromarray(mask).save(name)
        source = RecordingSource(path=mug_file, said={"mask": name})
        with open_session(common(), source, tmp_path / "run") as session:
            tracker.stage(session, SlamConfig())

    assert tracker.times == 2
    record = session.run.record("slam")
    assert record is not None
    assert record.settings["recording"]["mask"] == str(tmp_path.resolve() / "c.png")


def test_the_run_folder_holds_what_other_programs_rely_on(
    mug_file: Path, true_trajectory: SlamResult, tmp_path: Path
) -> None:
    """Fields, trajectory line by line, settings that can be given back."""
    run = tmp_path / "run"
    session = track(Tracker(true_trajectory), mug_file, run)

    summary = json.loads((run / "summary.json").read_text())
    slam = {"frames": 6, "lost_frames": 0, "lost": [], "hypotheses_max": 3.0, "path_probabilities": [1.0]}
    slam |= {"log_evidence": 60.0, "undiscovered_probability": 0.0, "warnings": []}
    slam |= {"distortion_per_m": 0.0, "distortion_std_per_m": 2e-3}
    spread_m = pytest.approx(np.sqrt(3e-6))
    slam |= {"position_std_m": spread_m, "largest_position_std_m": spread_m, "least_sure_frame": 0}
    slam["length_m"] = pytest.approx(path_length_m(true_trajectory))
    assert summary == {"slam": slam}
    document = stage_document(session.run, "slam")
    assert set(document) == {*summary["slam"], "seconds", "compile_s", "frames_per_second", "machine"}
    lines = (run / "trajectory.tum").read_text().splitlines()
    assert len(lines) == 6
    assert lines[0] == "1.000000000" + " 0.000000000" * 6 + " 1.000000000"
    assert len((run / "trajectory.kitti").read_text().split()) == 6 * 12
    profile = read_sensor_profile(run / "sensor.toml", true_trajectory.sensor.intrinsics)
    assert profile.distortion is not None
    np.testing.assert_array_equal(profile.distortion.sd_per_m, true_trajectory.disparity_sd_per_m)
    settings = tomllib.loads((run / "config.toml").read_text())
    assert settings["slam"]["particles"] == 3
    again = Settings.read(run / "config.toml", ())
    assert again.section("slam", SlamConfig) == SlamConfig(particles=3)
    assert RecordingSource(path=mug_file, said={}).read_options(again) == RecordingSource(
        path=mug_file, said={}
    ).read_options(Settings({}))


def test_derived_files_are_the_same_bytes_when_made_again(
    mug_file: Path, true_trajectory: SlamResult, tmp_path: Path
) -> None:
    """Whatever of them was lost."""
    run = tmp_path / "run"
    track(Tracker(true_trajectory), mug_file, run)
    derived = ("config.toml", "summary.json", "trajectory.tum", "trajectory.kitti", "slam.npz")
    before = [(run / name).read_bytes() for name in derived]
    for name in derived:
        (run / name).unlink()
    track(Tracker(true_trajectory), mug_file, run)

    assert [(run / name).read_bytes() for name in derived] == before


def test_names_of_recordings_and_runs_need_not_be_utf8(
    mug_file: Path, true_trajectory: SlamResult, tmp_path: Path
) -> None:
    """As of disks from elsewhere: everything is written, the views too."""
    folder = tmp_path / os.fsdecode(b"k\xfcche")
    folder.mkdir()
    shutil.copy(mug_file, recording := folder / os.fsdecode(b"k\xfcche.mcap"))
    track(Tracker(true_trajectory), recording, run := folder / os.fsdecode(b"k\xfcche.run"))
    command = ["eval", "slam", str(run), "--reference", str(recording), "-o", str(folder)]
    for arguments in (command, ["report", str(run), "-o", str(folder / "report.html")]):
        result = CliRunner().invoke(voxscene, [*arguments, "--quiet"])
        assert result.exit_code == 0, result.stderr
    assert (run / "run.rrd").is_file()
    assert "k?che.run" in (folder / "report.html").read_text(encoding="utf-8")


def test_every_stage_has_a_key_of_its_own(mug_file: Path, tmp_path: Path) -> None:
    """They follow from the seed, and stay when stages are added at the end."""
    with open_session(common(7), RecordingSource(path=mug_file, said={}), tmp_path / "run") as session:
        data = [jax.random.key_data(session.key(stage)).tolist() for stage in STAGES]
    longer = jax.random.split(jax.random.key(7), len(STAGES) + 1)

    assert len({tuple(one) for one in data}) == len(STAGES)
    assert data == np.asarray(jax.random.key_data(longer))[: len(STAGES)].tolist()


@pytest.mark.parametrize(
    "arguments", [["none.mcap"], ["none.mcap", "--every", "0"], ["none.mcap", "--start", "-1"]]
)
def test_reading_options_and_missing_files_are_named(arguments: list[str], tmp_path: Path) -> None:
    """One line."""

    @click.command()
    @recording_options
    @common_options("recording")
    def command(common: Common, source: RecordingSource) -> None:
        with open_session(common, source, tmp_path / "run"):
            pass

    result = CliRunner().invoke(command, arguments)
    assert result.exception is not None
    assert not isinstance(result.exception, SystemExit)
    assert "none.mcap" in str(result.exception) or "recording" in str(result.exception)
    assert Failure(str(result.exception)).exit_code == 1
    assert not (tmp_path / "run").exists()
