"""Two rigid motions in one frame, put together from two views whose poses are known."""

from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

from recordings.types import DepthNoise, Frame
from shapes.geometry.pose_sets import IDENTITY
from shapes.geometry.poses import single_precision_poses
from slam.keyframes.depth_view import CanvasView, view_of_frame
from slam.keyframes.surfels import surfel_image
from slam.registration.second_motion import TwoMotions, two_motions
from tests.slam import box_room

NOISE = DepthNoise()
HERE = jnp.asarray(IDENTITY, jnp.float32)
ORIGIN = box_room.pose(0.0, 0.0, -0.5)


def _view(depth: NDArray[np.float32]) -> CanvasView:
    return view_of_frame(Frame(time_ns=0, depth_m=depth), box_room.INTRINSICS)


def _seen(pose: NDArray[np.float64], seed: int) -> NDArray[np.float32]:
    return box_room.noisy(box_room.depth_image(pose), np.random.default_rng(seed))


def _with_body(depth: NDArray[np.float32], seed: int) -> NDArray[np.float32]:
    """A rippled surface, 0.7 m away, in the lower half."""
    v, u = np.mgrid[0 : depth.shape[0], 0 : depth.shape[1]]
    body = (0.7 + 0.05 * np.sin(u / 13) * np.cos(v / 9)).astype(np.float32)
    noisy = box_room.noisy(body, np.random.default_rng(seed))
    return np.where(v >= depth.shape[0] // 2, noisy, depth)


def _compared(
    before: NDArray[np.float32], depth: NDArray[np.float32], found: NDArray[np.float64]
) -> TwoMotions | None:
    """The frame against an earlier one."""
    surface = surfel_image(_view(before), NOISE)
    first = single_precision_poses(np.linalg.inv(ORIGIN) @ found)
    return two_motions(surface, _view(depth), NOISE, first, HERE)


@pytest.mark.parametrize("follows", ["room", "body"])
def test_two_motions_are_told_apart(follows: str):
    """Half of the view is fixed to the camera: told wherever the search begins, the body's motion to 4 mm.

    (What remains of the room, walls and a ceiling, hardly fixes the camera in this half.)
    """
    camera = box_room.pose(0.05, 0.03, -0.45, 0.03)
    before, depth = _with_body(_seen(ORIGIN, 3), 4), _with_body(_seen(camera, 1), 2)

    two = _compared(before, depth, camera if follows == "room" else ORIGIN)

    assert two is not None
    assert two.log_odds > 0
    assert two.explained > 0.8
    assert np.linalg.norm(np.asarray(two.poses)[:, 4:], axis=1).min() < 0.004
    assert min(two.shares) > 0.15


def test_one_motion_is_enough_where_nothing_moves():
    """Twelve frames on a way of 11 cm: the odds favour one motion, and none says two by chance."""
    poses = [box_room.pose(0.006 * t, 0.003 * t, -0.5 + 0.005 * t, 0.006 * t) for t in range(12)]

    found = [_compared(_seen(ORIGIN, 30 + t), _seen(pose, 10 + t), pose) for t, pose in enumerate(poses)]

    assert all(two is None or two.log_odds < 0 for two in found)


def _round_a_vase(angle_rad: float, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """A camera's pose and what it sees, 0.8 m from the axis of a vase on a round plate that it looks at."""
    camera = box_room.pose(-0.8 * np.sin(angle_rad), -0.1, 0.2 - 0.8 * np.cos(angle_rad), angle_rad)
    z = np.linspace(0.4, 1.2, 200, dtype=np.float32)
    v, u = np.mgrid[0:120, 0:160].astype(np.float32)
    x = ((u - box_room.INTRINSICS.cx) / box_room.INTRINSICS.fx)[..., None] * z
    y = ((v - box_room.INTRINSICS.cy) / box_room.INTRINSICS.fy)[..., None] * z - 0.1
    radius = np.where(np.abs(y) < 0.2, 0.12 + 0.04 * np.cos(25.0 * y), np.where(y < 0.23, 0.35, 0.0))
    within = (np.hypot(x, z - 0.8) < radius) & (y > -0.2)
    vase = np.where(within.any(axis=2), z[within.argmax(axis=2)], np.inf)
    depth = np.minimum(box_room.depth_image(camera), vase)
    return camera, box_room.noisy(depth, np.random.default_rng(seed))


def test_what_is_round_does_not_go_along_with_a_camera_that_goes_round_it():
    """Six steps of 12 degrees: more of it would be explained so, for it looks the same from everywhere."""
    views = [_round_a_vase(np.radians(12.0 * step), 50 + step) for step in range(7)]
    told = []
    for (before, earlier), (now, later) in pairwise(views):
        surface = surfel_image(_view(earlier), NOISE)
        first = single_precision_poses(np.linalg.inv(before) @ now)
        told.append(two_motions(surface, _view(later), NOISE, first, HERE))

    assert all(two is None or two.log_odds < 0 for two in told)


def test_an_image_of_nothing_says_nothing():
    """No returns: no second motion."""
    assert _compared(_seen(ORIGIN, 4), np.zeros((120, 160), np.float32), ORIGIN) is None
