"""Candidates anywhere in the map: steps uphill lead to the frame's place, which scores best."""

import jax
import jax.numpy as jnp
import numpy as np

from recordings.types import DepthNoise
from shapes.geometry import pose_gaussian
from shapes.geometry.poses import single_precision_poses
from slam.keyframes.depth_view import view_of_frame
from slam.keyframes.surfels import surfel_image
from slam.registration.global_search import ascend, log_map_scores
from slam.registration.local_map import LocalMap
from tests.slam import box_room

NOISE = DepthNoise()
KEYFRAMES = np.stack([box_room.pose(-0.2, 0.0, -0.6, 0.2), box_room.pose(0.3, 0.1, -0.4, -0.1)])
TRUTH = box_room.pose(0.1, 0.05, -0.5, 0.05, 0.05)
OFFSETS = [[0.1, -0.05, 0.08, 0, 0, 0], [0, 0, 0, 0.1, -0.1, 0.08], [-0.08, 0.06, 0.05, -0.08, 0.09, -0.05]]


def _local_map() -> LocalMap:
    views = [view_of_frame(frame, box_room.INTRINSICS) for frame in box_room.frames(KEYFRAMES, seed=1)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(surfel_image(view, NOISE) for view in views))
    return LocalMap(stacked, jnp.ones(len(views), bool), single_precision_poses(KEYFRAMES))


def test_neighbours_climb_to_the_mode_and_score_as_it_does():
    """From a tenth of a metre and of a radian away to a fifth of that, where a rendering goes on."""
    view = view_of_frame(box_room.frames(TRUTH[None], seed=2)[0], box_room.INTRINSICS)
    true = single_precision_poses(TRUTH[None])[0]
    starts = jax.vmap(lambda xi: pose_gaussian.displace(true, xi))(jnp.asarray(OFFSETS, jnp.float32))
    local_map = _local_map()

    found = ascend(local_map, view, NOISE, starts)

    errors = np.asarray(jax.vmap(lambda pose: pose_gaussian.coordinates(true, pose))(found))
    assert np.linalg.norm(errors[:, :3], axis=1).max() < 0.02
    assert np.linalg.norm(errors[:, 3:], axis=1).max() < 0.02
    before, after = (np.asarray(log_map_scores(local_map, view, NOISE, p, 0.01)) for p in (starts, found))
    assert (after > before + 100).all()
