"""`learn --preview` shows the region that would be learned; `--pixel` says which object is meant."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from PIL import Image

from pipeline.cli import voxscene
from pipeline.stages.region import LINE_COLOUR
from recordings.types import CameraIntrinsics, Damage
from shapes.learning.region import point_at_pixel

CAMERA = CameraIntrinsics(width=40, height=30, fx=35.0, fy=36.0, cx=18.5, cy=15.25)


def learn(mug_file: Path, tmp_path: Path, *arguments: str) -> Result:
    """A preview from the recording's own poses, which needs no tracking."""
    command = ["learn", str(mug_file), "--name", "mug", "--poses", "recorded", "--json", *arguments]
    picture = ["--preview", str(tmp_path / "box.png"), "-o", str(tmp_path / "run")]
    return CliRunner().invoke(voxscene, [*command, *picture])


def object_pixel(filmed_mug) -> tuple[float, float]:
    """Where the first frame shows the middle of the mug."""
    (mug,) = filmed_mug.truth.objects
    pose = np.linalg.inv(filmed_mug.trajectory.reference_from_camera[0]) @ mug.world_from_object
    x, y, z = pose[:3, :3] @ mug.vertices_m.mean(axis=0) + pose[:3, 3]
    camera = filmed_mug.intrinsics
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy


def test_the_region_is_drawn_round_the_object_and_nothing_is_learned(mug_file, filmed_mug, tmp_path) -> None:
    """Lines on all sides of the object's pixel, a size of a mug, no shape."""
    result = learn(mug_file, tmp_path)
    assert result.exit_code == 0, result.output
    size_m = json.loads(result.stdout)["size_m"]
    assert all(0.05 < side < 0.3 for side in size_m)
    with Image.open(tmp_path / "box.png") as picture:
        drawn = np.argwhere((np.asarray(picture.convert("RGB")) == LINE_COLOUR).all(axis=-1))
    column, row = object_pixel(filmed_mug)
    assert drawn[:, 0].min() < row < drawn[:, 0].max()
    assert drawn[:, 1].min() < column < drawn[:, 1].max()
    assert not (tmp_path / "run" / "shapes").exists()


def test_a_preview_of_a_damaged_recording_ends_with_its_code(
    mug_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As learning does: 3, with what was lost on stderr and the document on stdout."""
    lost = property(lambda _: Damage(lost_messages=2))
    monkeypatch.setattr("recordings.reading.McapRecording.damage", lost)
    result = learn(mug_file, tmp_path)

    assert result.exit_code == 3, result.output
    assert "at least 2 messages lost" in result.stderr
    assert json.loads(result.stdout)["preview"] == str(tmp_path / "box.png")


def test_a_pixel_on_the_object_means_the_object(mug_file, filmed_mug, tmp_path) -> None:
    """The region that is found where the cameras look, but for a few cells at its rim."""
    column, row = object_pixel(filmed_mug)
    told = json.loads(learn(mug_file, tmp_path, "--pixel", f"{column:.0f},{row:.0f}").stdout)
    found = json.loads(learn(mug_file, tmp_path).stdout)["size_m"]
    np.testing.assert_allclose(told["size_m"], found, atol=0.03)


@pytest.mark.parametrize(
    ("pixel", "code", "line"),
    [("5000,3", 1, "outside the image of 96x72"), ("3", 2, "write column,row"), ("a,b", 2, "numbers")],
)
def test_a_pixel_that_means_nothing_is_told(mug_file, tmp_path, pixel: str, code: int, line: str) -> None:
    """In one line."""
    result = learn(mug_file, tmp_path, "--pixel", pixel)
    assert result.exit_code == code
    assert line in result.stderr


def test_a_pixel_is_the_point_that_it_shows() -> None:
    """In the reference frame, by the median of what returned near it; without a return there is none."""
    depth_m = np.zeros((30, 40), np.float32)
    depth_m[8:12, 28:32] = 2.0
    pose = np.eye(4)
    pose[:3, 3] = [1, 0, 0]
    expected = [1 + 2 * (30 - 18.5) / 35, 2 * (10 - 15.25) / 36, 2]
    np.testing.assert_allclose(point_at_pixel(depth_m, CAMERA, pose, (30, 10)), expected)
    with pytest.raises(ValueError, match="nothing returned"):
        point_at_pixel(depth_m, CAMERA, pose, (5, 25))
