"""`voxscene calibrate` writes a profile that slam, learn and parse take, and refuses what it cannot use."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from pipeline.calibration.field import stands_still
from pipeline.calibration.images import RUN_FRAMES, profile_of, spread_evenly
from pipeline.cli import voxscene
from pipeline.stored_profile import StoredProfile, is_profile
from recordings.options import ReadOptions
from recordings.reading import open_recording
from recordings.sensor_profile import SensorProfile, load_sensor_profile
from recordings.types import CameraIntrinsics, DepthNoise, Frame
from recordings.writer import RecordingWriter
from shapes.depth_noise import standard_deviation

CAMERA = CameraIntrinsics(width=96, height=72, fx=84.0, fy=84.0, cx=47.5, cy=35.5)


def run(*arguments: str | Path) -> Result:
    """A command."""
    return CliRunner().invoke(voxscene, [str(one) for one in arguments])


def wall(path: Path, camera: CameraIntrinsics = CAMERA, frames: int = 6, seed: int = 0) -> Path:
    """A recording of a bare wall, leaning away, by a camera at rest."""
    rng = np.random.default_rng(seed)
    columns = np.arange(camera.width) / camera.width
    depth_m = np.tile(1 / (0.6 + 0.4 * columns), (camera.height, 1))
    with RecordingWriter(path, camera, depth_unit_m=None) as writer:
        for number in range(frames):
            noisy = depth_m + standard_deviation(DepthNoise(), depth_m) * rng.normal(size=depth_m.shape)
            writer.write_depth(Frame(time_ns=number * 10**8, depth_m=noisy.astype(np.float32)))
    return path


@pytest.fixture(scope="module")
def profile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a wall that two recordings show."""
    folder = tmp_path_factory.mktemp("calibrated")
    paths = [wall(folder / f"{name}.mcap", seed=number) for number, name in enumerate("ab")]
    result = run("calibrate", *paths, "-o", folder / "sensor.toml", "--json")
    assert result.exit_code == 0, result.output
    (folder / "told.json").write_text(result.stdout)
    return folder / "sensor.toml"


def test_the_profile_tells_the_noise(profile: Path) -> None:
    """Sigma of the wall to 15% by 12 frames of few windows; every table but that of the distortion."""
    found = load_sensor_profile(profile)
    assert found.noise is not None
    depths_m = np.array([1.1, 1.5])
    ratio = standard_deviation(found.noise, depths_m) / standard_deviation(DepthNoise(), depths_m)
    assert np.abs(np.log(ratio)).max() < 0.15
    assert found.unknown is not None
    assert found.distortion is None
    assert found.source is not None
    assert (found.source.recordings, found.source.frames) == (("a.mcap", "b.mcap"), 12)
    told = json.loads((profile.parent / "told.json").read_text())
    assert told["distortion_per_m"] is None
    assert [one["frames"] for one in told["tracked"]] == [0, 0]  # the camera stands still


def test_a_table_for_people_says_what_is_little(profile: Path, tmp_path: Path) -> None:
    """One frame is said to be few; progress and warnings go to stderr."""
    result = run("calibrate", profile.parent / "a.mcap", "--frames", "1", "-o", tmp_path / "one.toml")
    assert result.exit_code == 0
    for word in ("sigma, mm", "missing", "correlation", "distortion    not learnt"):
        assert word in result.stdout
    assert "learnt from 1 frame:" in result.stderr


def test_a_moving_camera_tells_the_distortion(mug_file: Path, tmp_path: Path) -> None:
    """As slam does; few small views leave its deviations near the prior's."""
    result = run(*("calibrate", mug_file, "-o", tmp_path / "sensor.toml", "-q", "-s", "slam.particles=16"))
    assert result.exit_code == 0, result.output
    found = load_sensor_profile(tmp_path / "sensor.toml").distortion
    assert found is not None
    assert (found.sd_per_m < 0.01).all()


def test_runs_write_what_they_use(profile: Path) -> None:
    """A given profile is what the run keeps; without one it learns from its own frames."""
    given = open_recording(profile.parent / "a.mcap", ReadOptions(sensor=profile))
    used = profile_of(given, 6)
    assert used.table() == load_sensor_profile(profile).table()
    own = profile_of(open_recording(profile.parent / "a.mcap"), 6)
    assert own.source is not None
    assert own.source.recordings == ("a.mcap",)


def test_a_profile_of_version_1_is_completed(profile: Path, tmp_path: Path) -> None:
    """What it does not say is learnt from the recording; its field stays."""
    table = load_sensor_profile(profile).table()
    field = f"disparity_per_m = {7 * [9 * [0.001]]}\nsd_per_m = {7 * [9 * [0.0005]]}"
    image = "\n".join(f"{name} = {value}" for name, value in table["image"].items())
    (tmp_path / "old.toml").write_text(f"format_version = 1\n[image]\n{image}\n[distortion]\n{field}\n")
    recording = open_recording(profile.parent / "a.mcap", ReadOptions(sensor=tmp_path / "old.toml"))
    found = profile_of(recording, 6)
    assert found.distortion is not None
    assert found.noise is not None
    assert found.unknown is not None


def test_mistakes_are_told_in_one_line(profile: Path, tmp_path: Path) -> None:
    """Other cameras, no depth, no folder, no recording, damaged and impossible profiles."""
    one = profile.parent / "a.mcap"
    other = wall(tmp_path / "other.mcap", CAMERA.resized(192, 144), 1)
    narrow = wall(tmp_path / "narrow.mcap", CameraIntrinsics(**{**vars(CAMERA), "fx": 160.0, "fy": 160.0}), 1)
    with RecordingWriter(tmp_path / "empty.mcap", CAMERA, depth_unit_m=None):
        pass
    cut, negative = tmp_path / "cut.toml", tmp_path / "negative.toml"
    cut.write_bytes(profile.read_bytes()[:700])
    negative.write_text(profile.read_text().replace("sigma_base_m = 0", "sigma_base_m = -0"))
    out = ("-o", tmp_path / "sensor.toml", "-q")
    slam = ("slam", one, "-o", tmp_path / "run", "-q", "--sensor")
    for arguments, told in [
        (("calibrate", one, other, *out), "another camera or size"),
        (("calibrate", tmp_path / "empty.mcap", *out), "no depth"),
        (("calibrate", tmp_path / "none.mcap", *out), "none.mcap"),
        (("calibrate", one, "-o", tmp_path / "no" / "sensor.toml"), "no folder"),
        (("calibrate", one, "-o", tmp_path), "it is a folder"),
        ((*slam, cut), "no sensor profile"),
        ((*slam, negative), "sigma_base_m must lie within"),
        ((*slam, tmp_path / "none.toml"), "cannot read the sensor profile"),
        (("slam", narrow, "-o", tmp_path / "run", "-q", "--sensor", profile), "another camera"),
    ]:
        result = run(*arguments)
        assert result.exit_code == 1, arguments
        assert told in result.output
        assert len(result.stderr.strip().splitlines()) == 1
        assert not (tmp_path / "sensor.toml").exists()


def test_a_profile_takes_the_place_of_a_profile_alone(tmp_path: Path) -> None:
    """A file of settings named by mistake stays as it is."""
    film, settings = wall(tmp_path / "a.mcap"), tmp_path / "project.toml"
    settings.write_text("[run]\nseed = 3\n")
    told = run("calibrate", film, "-o", settings, "-q")
    assert (told.exit_code, told.stderr.count("\n")) == (1, 1)
    assert "project.toml: it is there and is no sensor profile, name another file" in told.stderr
    assert settings.read_text() == "[run]\nseed = 3\n"
    profile = StoredProfile(SensorProfile(intrinsics=CAMERA))
    profile.save(tmp_path / "sensor.toml")
    assert is_profile(tmp_path / "sensor.toml")


def test_what_is_calibrated_is_read_as_it_was_recorded(profile: Path, tmp_path: Path) -> None:
    """Not corrected by an older profile, whose distortion the new one would lack."""
    for said in (["--sensor", profile], ["-s", f"recording.sensor={profile}"]):
        result = run("calibrate", profile.parent / "a.mcap", *said, "-o", tmp_path / "sensor.toml")
        assert result.exit_code == 2
        assert result.stderr.count("\n") == 1
        assert "leave out --sensor" in result.stderr
        assert not (tmp_path / "sensor.toml").exists()


def test_frames_are_spread_evenly() -> None:
    """From the first to the last, each once."""
    assert spread_evenly(0, 5) == []
    assert spread_evenly(3, RUN_FRAMES) == [0, 1, 2]
    assert spread_evenly(101, 5) == [0, 25, 50, 75, 100]


def test_a_camera_at_rest_is_known_by_its_images(seed: int) -> None:
    """Noise alone is no motion; a centimetre at 1 m is."""
    rng = np.random.default_rng(seed)
    still = [(1.0 + 0.002 * rng.normal(size=(48, 64))).astype(np.float32) for _ in range(3)]
    assert stands_still(still, DepthNoise())
    assert not stands_still([*still, still[0] + np.float32(0.01)], DepthNoise())


def test_a_chosen_frame_is_read_as_among_all(mug_file: Path) -> None:
    """The same pixels, and the others are passed over."""
    every = list(open_recording(mug_file))
    found = list(open_recording(mug_file).chosen({1, 4}))
    assert [one.time_ns for one in found] == [every[1].time_ns, every[4].time_ns]
    np.testing.assert_array_equal(found[1].depth_m, every[4].depth_m)


def test_a_project_names_its_profile_beside_itself(tmp_path: Path) -> None:
    """Relative to the project file, for all recordings and for one."""
    from pipeline.project import read_project

    project = tmp_path / "project.toml"
    project.write_text(
        'sensor = "a.toml"\n[[recording]]\npath = "x.mcap"\nstage = "slam"\n'
        '[[recording]]\npath = "y.mcap"\nstage = "slam"\nsensor = "b.toml"\n'
    )
    first, second = read_project(project).recordings
    assert first.reading["sensor"] == str(tmp_path / "a.toml")
    assert second.reading["sensor"] == str(tmp_path / "b.toml")
