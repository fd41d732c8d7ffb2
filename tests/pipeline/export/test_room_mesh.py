"""The room as triangles lies where the room is, in its colours, and only where it was seen."""

from typing import Any

import numpy as np
import pytest

from pipeline.errors import PipelineError
from pipeline.export.room_mesh import room_mesh
from pipeline.room import UNSEEN_GREY
from recordings.types import CameraIntrinsics, Frame

CAMERA = CameraIntrinsics(width=80, height=60, fx=70.0, fy=70.0, cx=39.5, cy=29.5)
WALL_M = 1.5
RED = (200, 40, 30)


def frames(*, colour: bool = True, returns: bool = True) -> list[tuple[Frame, np.ndarray]]:
    """Five views of a wall, from places side by side; the left half of it is never shown in colour."""
    found = []
    for number in range(5):
        pose = np.eye(4)
        pose[0, 3] = 0.05 * number
        depth_m = np.full((60, 80), WALL_M if returns else 0.0, np.float32)
        columns = np.arange(80)[None, :].repeat(60, axis=0)
        known = (columns - CAMERA.cx) / CAMERA.fx * WALL_M + pose[0, 3] > 0
        rgb = np.where(known[..., None], RED, 0).astype(np.uint8)
        frame = Frame(time_ns=number, depth_m=depth_m, rgb=rgb if colour else None, rgb_known=known)
        found.append((frame, pose))
    return found


def test_triangles_lie_on_the_wall_in_its_colours() -> None:
    """Within a tenth of a voxel of the plane; red where colour was seen, grey elsewhere."""
    mesh = room_mesh(lambda: frames(), CAMERA, pitch_m=0.02)
    assert np.abs(mesh.vertices[:, 2] - WALL_M).max() < 0.002
    assert mesh.extents[0] > 1.5
    visual: Any = mesh.visual
    colours = np.asarray(visual.vertex_colors)[:, :3]
    red = (colours == RED).all(axis=1)
    grey = (colours == UNSEEN_GREY).all(axis=1)
    assert (red | grey).all()
    assert (mesh.vertices[red, 0] > -0.03).all()
    assert (mesh.vertices[grey, 0] < 0.03).all()
    assert (mesh.face_normals[:, 2] < 0).mean() > 0.99


def test_without_colour_there_is_none() -> None:
    """No invented grey."""
    mesh = room_mesh(lambda: frames(colour=False), CAMERA, pitch_m=0.02)
    visual: Any = mesh.visual
    assert visual.kind != "vertex"


def test_a_frame_without_a_return_changes_nothing() -> None:
    """A lens that was covered for a moment costs that moment."""
    views = frames()
    covered = [*views, (frames(returns=False)[0][0], np.eye(4))]
    assert len(room_mesh(lambda: covered, CAMERA, pitch_m=0.02).faces) == len(
        room_mesh(lambda: views, CAMERA, pitch_m=0.02).faces
    )


def test_nothing_seen_is_told() -> None:
    """Instead of an empty file."""
    with pytest.raises(PipelineError, match="too little for a surface"):
        room_mesh(lambda: frames(returns=False), CAMERA)


@pytest.mark.parametrize("count", [1, 2])
def test_few_frames_show_what_they_saw(count: int) -> None:
    """Where no surface is seen by three of them the wall is there all the same."""
    mesh = room_mesh(lambda: frames()[:count], CAMERA, pitch_m=0.02)
    assert mesh.extents[0] > 1.5
    assert np.abs(mesh.vertices[:, 2] - WALL_M).max() < 0.002


def test_what_one_of_many_frames_saw_is_left_out() -> None:
    """A film of a wall, and one frame of a nearer one."""
    views = [view for _ in range(3) for view in frames()]
    blink = np.full((60, 80), 0.6, np.float32)
    odd = Frame(time_ns=99, depth_m=np.where(np.arange(80) < 8, blink, WALL_M).astype(np.float32))
    mesh = room_mesh(lambda: [*views, (odd, np.eye(4))], CAMERA, pitch_m=0.02)
    assert mesh.vertices[:, 2].min() > WALL_M - 0.05
