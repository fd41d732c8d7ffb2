"""`import voxscene` gives what the command line gives."""

import ast
import importlib.util
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner
from PIL import Image

from pipeline import interface
from pipeline.cli import voxscene
from pipeline.stored_profile import StoredProfile
from scene.config import ParseConfig
from slam.result import SlamResult

ROOT = Path(__file__).parents[2]


def test_tracking_gives_the_bytes_of_the_command_line(mug_file: Path, tmp_path: Path) -> None:
    """Same recording, seed and settings: the same saved trajectory."""
    command = ["slam", str(mug_file), "-o", str(tmp_path / "run"), "--seed", "3", "-s", "slam.particles=16"]
    result = CliRunner().invoke(voxscene, [*command, "--every", "2", "--quiet"])
    assert result.exit_code == 0, result.output
    trajectory = interface.track(interface.open_recording(mug_file, every=2), seed=3, particles=16)
    trajectory.save(tmp_path / "own.npz")
    assert (tmp_path / "own.npz").read_bytes() == (tmp_path / "run" / "slam.npz").read_bytes()


def test_recordings_open_with_options_and_bring_their_poses(mug_file: Path) -> None:
    """Every second frame, and the poses for comparison."""
    recording = interface.open_recording(mug_file, every=2)
    assert len(list(recording)) == 3
    trajectory = interface.recorded_trajectory(mug_file, every=2)
    assert trajectory is not None
    assert trajectory.reference_from_camera.shape == (3, 4, 4)
    assert np.isfinite(trajectory.reference_from_camera).all()


def test_files_of_reading_may_be_named_by_words(
    mug_file: Path, true_trajectory: SlamResult, tmp_path: Path
) -> None:
    """As the recording itself: a sensor's profile and a mask."""
    camera = interface.open_recording(mug_file).intrinsics
    StoredProfile(replace(true_trajectory.sensor, intrinsics=camera)).save(tmp_path / "camera.toml")
    left_out = np.zeros((camera.height, camera.width), np.uint8)
    left_out[:, 40:] = 255
    Image.fromarray(left_out).save(tmp_path / "mask.png")
    files = {"sensor": str(tmp_path / "camera.toml"), "mask": str(tmp_path / "mask.png")}
    frame = next(iter(interface.open_recording(str(mug_file), **files)))
    assert frame.depth_m[:, 40:].any()
    assert not frame.depth_m[:, :40].any()


def test_a_setting_that_does_not_exist_is_refused(mug_file: Path) -> None:
    """Before any work, by Python's own error."""
    with pytest.raises(TypeError, match="particels"):
        interface.track(interface.open_recording(mug_file), particels=16)


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"particles": 2.5}, "slam.particles: input should be a valid integer.*, got 2.5"),
        ({"particles": "many"}, "slam.particles: .*, got 'many'"),
        ({"particles": 1}, "slam: particles must lie within 2 and 16384, got 1"),
    ],
)
def test_a_value_of_another_kind_is_one_clear_line(mug_file: Path, settings: dict, line: str) -> None:
    """As on the command line, and not an error of what is computed with it."""
    with pytest.raises(ValueError, match=line):
        interface.track(interface.open_recording(mug_file), **settings)
    with pytest.raises(ValueError, match=r"recording.every: input should be a valid integer"):
        interface.open_recording(mug_file, every=1.5)
    with pytest.raises(ValueError, match=r"parse.frames: input should be a valid tuple, got 3"):
        interface.parse(interface.open_recording(mug_file), ".", frames=3)


def test_settings_may_be_arrays_and_lists(
    mug_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first frame is meant by its number, and not one that shows more."""
    camera = interface.open_recording(mug_file).intrinsics
    four = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    recording = interface.open_recording(mug_file, intrinsics=four)
    assert recording.options.intrinsics == tuple(four.tolist())
    asked: list[ParseConfig] = []

    def parsed(*arguments: object) -> None:
        asked.extend(one for one in arguments if isinstance(one, ParseConfig))

    monkeypatch.setattr("pipeline.stages.parse.parse_recording", parsed)
    monkeypatch.setattr("pipeline.calibration.images.profile_of", lambda *_: None)
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "box.ply")
    for frames in (np.array([0]), [0], range(1)):
        support = np.array([0, 0, 1, 0, 0, -1])
        interface.parse(recording, tmp_path, objects=["box"], frames=frames, support=support)
    assert asked == 3 * [ParseConfig(objects=("box",), frames=(0,), support=(0, 0, 1, 0, 0, -1))]
    with pytest.raises(ValueError, match="support must be a finite number"):
        interface.parse(recording, tmp_path, support=[0, 0, np.nan, 0, 0, -1])


def test_a_colour_image_alone_is_the_command_lines(mug_file: Path, tmp_path: Path) -> None:
    """It is refused, and never parsed by depth instead."""
    with pytest.raises(ValueError, match="--colour only"):
        interface.parse(interface.open_recording(mug_file), tmp_path, colour="only")


def test_several_frames_need_a_trajectory(mug_file: Path, tmp_path: Path) -> None:
    """Nobody else knows where the camera was."""
    with pytest.raises(ValueError, match="trajectory"):
        interface.parse(interface.open_recording(mug_file), tmp_path, frames=(0, 1))


def test_lost_frames_and_missing_ones_are_refused(
    mug_file: Path, true_trajectory: SlamResult, tmp_path: Path
) -> None:
    """Their poses mean nothing."""
    recording = interface.open_recording(mug_file)
    lost = replace(true_trajectory, lost=np.arange(6) == 3)
    with pytest.raises(interface.PipelineError, match="slam lost frame 3"):
        interface.parse(recording, tmp_path, trajectory=lost, frames=(2, 3))
    with pytest.raises(interface.PipelineError, match="no frame 6; the recording has 6"):
        interface.parse(recording, tmp_path, trajectory=true_trajectory, frames=(0, 6))


def test_another_recordings_trajectory_is_refused(
    mug_file: Path, true_trajectory: SlamResult, tmp_path: Path
) -> None:
    """So is that of frames which this one leaves out."""
    other = replace(true_trajectory, times_ns=true_trajectory.times_ns + 1)
    for options, trajectory in ({}, other), ({"every": 2}, true_trajectory):
        recording = interface.open_recording(mug_file, **options)
        with pytest.raises(interface.PipelineError, match="of other frames"):
            interface.learn(recording, trajectory)
        with pytest.raises(interface.PipelineError, match="of other frames"):
            interface.parse(recording, tmp_path, trajectory=trajectory, frames=(0, 1))


def test_the_package_gives_the_interface_and_is_typed() -> None:
    """The folder that the wheel ships as `voxscene`: every documented name, and py.typed."""
    folder = ROOT / "pipeline" / "package" / "voxscene"
    spec = importlib.util.spec_from_file_location("voxscene", folder / "__init__.py")
    assert spec is not None
    assert spec.loader is not None
    package = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(package)
    assert package.__all__ == interface.__all__
    assert all(hasattr(package, name) for name in interface.__all__)
    assert (folder / "py.typed").is_file()


def test_importing_starts_no_viewer_and_no_mesh_library() -> None:
    """Rerun and Open3D are loaded when something asks for them."""
    code = (
        "import sys, pipeline.interface; print(sorted({'rerun', 'open3d', 'matplotlib'} & set(sys.modules)))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert ast.literal_eval(found.stdout) == []


@pytest.mark.parametrize("name", sorted(set(interface.__all__)))
def test_every_name_is_documented(name: str) -> None:
    """With at least a sentence."""
    assert (getattr(interface, name).__doc__ or "").strip()
