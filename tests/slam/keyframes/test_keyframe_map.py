"""Which keyframes a camera is compared with, in a hall that is 10 m deep in sight."""

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN, CameraIntrinsics, Frame
from shapes.geometry.camera import Camera
from slam.keyframes.depth_view import CanvasView, framing, view_of_frame
from slam.keyframes.keyframe_map import KeyframeMap, sample_points, selected_keyframes
from slam.keyframes.surfels import SurfelImage
from tests.slam import box_room

HALF_M: NDArray[np.float64] = np.asarray([0.9, 1.2])
"""Across and upwards, from the middle of the hall."""
RANGE_M = 10.0


def _hall() -> CanvasView:
    """What a camera sees that looks along the hall, wherever it stands there, and whichever way it looks."""
    intrinsics = box_room.INTRINSICS
    v, u = np.mgrid[0 : intrinsics.height, 0 : intrinsics.width]
    slopes = np.stack([u - intrinsics.cx, v - intrinsics.cy], axis=-1) / intrinsics.fx
    depth = (HALF_M / np.abs(slopes)).min(axis=-1)
    depth = np.where(depth < RANGE_M, depth, NO_RETURN).astype(np.float32)
    return view_of_frame(Frame(time_ns=0, depth_m=depth, rgb=None), intrinsics)


def _selected(keyframes: NDArray[np.float64], count: int) -> list[int]:
    """By a camera at the hall's origin, of keyframes (N, 4, 4) there."""
    view = _hall()
    points = sample_points(view)
    of_keyframes = [points] * len(keyframes)
    return selected_keyframes(of_keyframes, keyframes, points, np.eye(4), framing(view), count).tolist()


def test_a_keyframe_far_ahead_is_not_compared_though_all_of_its_points_are_in_the_image():
    """Seven metres on it saw what the camera shows in a few pixels: the view beside the camera is closer."""
    ahead, beside, behind = (box_room.pose(0.0, 0.0, z) for z in (7.0, 0.1, -0.4))

    assert _selected(np.stack([ahead, beside, behind]), 4) == [1, 2]


def test_where_no_view_overlaps_the_nearest_camera_is_chosen():
    """All look the other way."""
    back = np.stack([box_room.pose(0.0, 0.0, z, np.pi) for z in (-4.0, -1.0, -2.0)])

    assert _selected(back, 4) == [1]


def test_surfaces_are_alike_to_kernels_whether_they_were_paged_or_not():
    """Free and bound arrays among the arguments of one kernel would have it compiled for every mixture."""
    camera = Camera.from_intrinsics(CameraIntrinsics(width=8, height=6, fx=8.0, fy=8.0, cx=3.5, cy=2.5))
    plane, vectors = jnp.ones((6, 8)), jnp.ones((3, 6, 8))
    made = SurfelImage(plane, vectors, plane, plane > 0, vectors, camera)
    (held,) = KeyframeMap().with_keyframe(made).surfaces
    paged = held.value.with_stored([np.asarray(array) for array in made.stored()])

    assert not any(array.committed for array in made.stored())
    for surface in (held.value, paged):
        assert all(array.committed for array in surface.stored())
        np.testing.assert_array_equal(surface.planes, vectors)
    assert made.with_stored([None] * 3).depth_m is None
