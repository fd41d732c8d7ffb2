"""Joint refinement of keyframes on a filter state whose drift is known."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from recordings.types import DepthNoise
from shapes.geometry.poses import matrices_of
from slam.config import SlamConfig
from slam.filter.init import init
from slam.filter.state import FilterState
from slam.filter.step import step
from slam.keyframes.depth_view import FINE_CANVAS, view_of_frame
from slam.keyframes.pages import PageFile
from slam.pose_graph.overlaps import keyframe_detail
from slam.pose_graph.refinement import refine_keyframes
from tests.slam import box_room

CONFIG = SlamConfig(particles=8)
DRIFT_M = 0.004
"""A keyframe after another."""


NOISE = DepthNoise()
NO_DISTORTION = np.full((7, 9), 1e-6)
"""Standard deviations of a sensor that is known to have none."""
POSES = np.stack([box_room.pose(0.12 * i, 0.05 * i, -0.5, 0.21 * i) for i in range(4)])


FRAMES = box_room.frames(POSES, seed=3)
PAGES = PageFile()
DETAILS = [
    PAGES.hold(keyframe_detail(view_of_frame(frame, box_room.INTRINSICS, FINE_CANVAS), NOISE))
    for frame in FRAMES
]


@pytest.fixture(scope="module")
def tracked() -> FilterState:
    """Four keyframes that overlap."""
    frames = FRAMES
    views = [view_of_frame(frame, box_room.INTRINSICS) for frame in frames]
    state, _ = init(views[0], frames[0].time_ns, CONFIG)
    for index, (view, frame) in enumerate(zip(views[1:], frames[1:], strict=True)):
        state, _ = step(jax.random.key(index), state, view, frame.time_ns, CONFIG)
    return state


def _drifted(state: FilterState, offsets_m: np.ndarray | None = None) -> FilterState:
    """The state with keyframes displaced along x, by `DRIFT_M` a keyframe after another as a rule."""
    drifted = state.keyframe_poses.copy()
    drifted[..., 4] += DRIFT_M * np.arange(drifted.shape[1]) if offsets_m is None else offsets_m
    return replace(state, keyframe_poses=drifted)


def _keyframes(state: FilterState) -> np.ndarray:
    weights = np.exp(np.asarray(state.population.log_weights))
    return np.einsum("k,knij->nij", weights, matrices_of(state.keyframe_poses))


def _errors_m(state: FilterState) -> np.ndarray:
    truth = np.linalg.inv(POSES[0]) @ POSES
    return np.linalg.norm(_keyframes(state)[:, :3, 3] - truth[:, :3, 3], axis=-1)


def test_drift_is_undone(key, tracked):
    """Over a third of the largest error goes, though little holds this camera; the first keyframe stays."""
    assert len(tracked.keyframe_map) == len(POSES)
    drifted = _drifted(tracked)

    after, _ = refine_keyframes(key, drifted, DETAILS, NOISE, NO_DISTORTION)

    assert _errors_m(after)[0] == 0.0
    assert _errors_m(after).max() < 0.65 * _errors_m(drifted).max()
    assert after.keyframe_map is tracked.keyframe_map


def test_drift_of_decimetres_is_undone(key, tracked):
    """To the optimum that is found without any drift, within a millimetre for every keyframe."""
    drifted = _drifted(tracked, 0.05 * np.arange(len(POSES)))

    _, right = refine_keyframes(jax.random.clone(key), tracked, DETAILS, NOISE, NO_DISTORTION)
    _, after = refine_keyframes(key, drifted, DETAILS, NOISE, NO_DISTORTION)

    np.testing.assert_allclose(after.poses[0, :, 4:], right.poses[0, :, 4:], atol=0.001)


def test_a_keyframe_that_overlaps_with_none_is_not_held(key, tracked):
    """The filter has it in another house."""
    astray = _drifted(tracked, np.asarray([0.0, 0.0, 0.0, 50.0]))

    _, placed = refine_keyframes(key, astray, DETAILS, NOISE, NO_DISTORTION)

    assert placed.held.tolist() == [[True, True, True, False]]


def test_equal_keys_give_equal_poses(key, tracked):
    """Repair draws from its key alone."""
    first, second = (
        refine_keyframes(jax.random.clone(key), tracked, DETAILS, NOISE, NO_DISTORTION)[0] for _ in range(2)
    )
    np.testing.assert_array_equal(first.keyframe_poses, second.keyframe_poses)


def test_a_lone_keyframe_stays(key):
    """Without overlaps there is nothing to repair."""
    view = view_of_frame(box_room.frames(box_room.walk(1))[0], box_room.INTRINSICS)
    state, _ = init(view, 0, CONFIG)
    after, placed = refine_keyframes(key, state, DETAILS[:1], NOISE, NO_DISTORTION)

    assert placed.held.tolist() == [[True]]
    np.testing.assert_allclose(placed.sd_per_m[0], 1e-6 * np.sqrt(62 / 63), rtol=1e-4)
    np.testing.assert_array_equal(after.keyframe_poses, state.keyframe_poses)
