"""Joint refinement of keyframes on a filter state whose drift is known."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pipeline.benchmarks.slam_cases import short_walk
from recordings.types import DepthNoise
from shapes.geometry import pose_gaussian
from shapes.geometry.poses import matrices_of
from slam.config import SlamConfig
from slam.filter.init import init
from slam.filter.state import FilterState
from slam.filter.step import step
from slam.keyframes.depth_view import FINE_CANVAS, view_of_frame
from slam.keyframes.pages import PageFile
from slam.pose_graph.growing_map import REFINED_EVERY, is_due, refined_so_far
from slam.pose_graph.overlaps import KeyframeImages, keyframe_detail
from slam.pose_graph.refinement import MapMixture, RefinedKeyframes, dealt, refine_keyframes
from slam.tracking import track
from tests.slam import box_room
from tests.statistical import assert_mean

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


def _maps(state: FilterState, offsets_m: np.ndarray | None = None) -> MapMixture:
    """The state's map with keyframes displaced along x."""
    maps = MapMixture.of(state.population)
    poses = maps.poses.copy()
    poses[..., 4] += 0.0 if offsets_m is None else offsets_m
    return replace(maps, poses=poses)


def _refined(key: jax.Array, maps: MapMixture, state: FilterState, count: int = 8) -> RefinedKeyframes:
    images = KeyframeImages(
        keyframe_map=state.keyframe_map, details=DETAILS[: len(state.keyframe_map)], noise=NOISE
    )
    return refine_keyframes(key, images, maps, count, NO_DISTORTION)


def _errors_m(poses: np.ndarray) -> np.ndarray:
    truth = np.linalg.inv(POSES[0]) @ POSES
    return np.linalg.norm(poses[..., 4:] - truth[:, :3, 3], axis=-1)


def test_drift_is_undone(key, tracked):
    """Over a third of the largest error goes, though little holds this camera; the first keyframe stays."""
    assert len(tracked.keyframe_map) == len(POSES)
    drifted = _maps(tracked, DRIFT_M * np.arange(len(POSES)))

    after = _refined(key, drifted, tracked)

    assert _errors_m(after.poses)[0, 0] == 0.0
    assert _errors_m(after.poses).max() < 0.65 * _errors_m(drifted.poses).max()


def test_drift_of_decimetres_is_undone(key, tracked):
    """To the optimum that is found without any drift, within a millimetre for every keyframe."""
    drifted = _maps(tracked, 0.05 * np.arange(len(POSES)))

    right = _refined(jax.random.clone(key), _maps(tracked), tracked)
    after = _refined(key, drifted, tracked)

    np.testing.assert_allclose(after.poses[..., 4:], right.poses[..., 4:], atol=0.001)


def test_a_growing_map_is_refined_and_the_camera_moves_along(tracked, monkeypatch):
    """Drift of the last keyframes goes while the first two are fixed; the last motion is what it was."""
    one, right = tracked.population.heaviest, _maps(tracked).poses[0]
    by = np.asarray([0.0, 0.0, 0.02, 0.04], np.float32)[:, None] * np.asarray([0, 0, 0, 0, 1, 0, 0])
    drifted = replace(
        one,
        keyframe_poses=(right + by).astype(np.float32),
        pose=(right[3] + by[3]).astype(np.float32),
        previous_pose=(right[2] + by[3]).astype(np.float32),
    )
    state = replace(tracked, population=replace(tracked.population, histories=(drifted,)))
    images = KeyframeImages(keyframe_map=state.keyframe_map, details=DETAILS, noise=NOISE)

    monkeypatch.setattr("slam.pose_graph.growing_map.FREE_KEYFRAMES", 2)

    after = refined_so_far(state, images)

    moved = after.population.heaviest
    np.testing.assert_array_equal(moved.keyframe_poses[:2], right[:2])
    assert _errors_m(moved.keyframe_poses).max() < _errors_m(right).max() + 0.002
    np.testing.assert_array_equal(moved.pose, moved.keyframe_poses[3])
    steps = [np.linalg.inv(matrices_of(of.previous_pose)) @ matrices_of(of.pose) for of in (drifted, moved)]
    np.testing.assert_allclose(steps[1], steps[0], atol=1e-6)
    assert (after.refined_keyframes, after.contradicted) == (4, False)


def test_the_map_is_refined_after_so_many_keyframes_or_where_they_contradict_each_other(tracked):
    """Twenty; four."""
    early = replace(tracked, refined_keyframes=0)

    assert not is_due(early)
    assert is_due(replace(early, contradicted=True))
    assert is_due(replace(early, refined_keyframes=4 - REFINED_EVERY))


def test_a_keyframe_that_little_holds_does_not_slide_along_a_wall(key):
    """The filter has it 6 mm off; steps that nobody asks led half a metre along, 640 nats downhill.

    A short walk whose sensor has a distortion field, of those that were looked at.
    """
    case = short_walk(73100, 0.0015)

    result = track(key, case.frames, case.intrinsics, CONFIG)

    assert not result.lost.any()
    assert np.linalg.norm(result.mean[:, :3, 3] - case.poses[:, :3, 3], axis=1).max() < 0.06


def test_a_keyframe_that_overlaps_with_none_is_not_held(key, tracked):
    """The filter has it in another house, where it stays; nothing is told of it."""
    astray = _maps(tracked, np.asarray([0.0, 0.0, 0.0, 50.0]))

    placed = _refined(key, astray, tracked)

    assert placed.held.tolist() == [[True, True, True, False]]
    np.testing.assert_array_equal(placed.poses[0, 3], astray.poses[0, 3])
    np.testing.assert_array_equal(placed.drawn[:, 3], np.tile(astray.poses[0, 3], (8, 1)))
    assert not placed.covariances[0, 3].any()
    assert not placed.sensitivity[0, 3].any()


def test_a_map_that_leaves_the_numbers_stays_as_the_filter_has_it(key, tracked, monkeypatch):
    """Its draws are poses all the same, and nothing is held but the first."""
    maps = _maps(tracked)
    monkeypatch.setattr(
        "slam.pose_graph.refinement.draw_poses", lambda poses, _: np.full((8, *poses.shape), np.nan)
    )

    refined = _refined(key, maps, tracked)

    np.testing.assert_array_equal(refined.drawn, np.tile(maps.poses[0], (8, 1, 1)))
    assert refined.held[0].tolist() == [True] + [False] * (len(maps.poses[0]) - 1)


def test_draws_have_the_graph_s_spread_and_do_not_depend_on_their_number(key, tracked):
    """Of two maps as often as they are probable; squared distances from each have their chi-square's mean."""
    maps = _maps(tracked)
    both = MapMixture(
        poses=np.repeat(maps.poses, 2, axis=0),
        probabilities=np.asarray([0.75, 0.25]),
        hypotheses=np.zeros(2, int),
        known=maps.known * 2,
    )

    placed = _refined(jax.random.clone(key), both, tracked, count=400)
    few = _refined(key, both, tracked, count=8)

    np.testing.assert_array_equal(few.mode, placed.mode[:8])
    np.testing.assert_allclose(few.drawn, placed.drawn[:8], atol=1e-6)
    np.testing.assert_allclose(np.bincount(placed.mode) / 400, both.probabilities, atol=0.01)
    for keyframe in range(1, len(POSES)):
        centres = jnp.asarray(placed.poses[placed.mode, keyframe])
        drawn = jnp.asarray(placed.drawn[:, keyframe])
        tangents = np.asarray(jax.vmap(pose_gaussian.coordinates)(centres, drawn), np.float64)
        covariances = placed.covariances[placed.mode, keyframe]
        squared = np.einsum("ki,ki->k", tangents, np.linalg.solve(covariances, tangents[..., None])[..., 0])
        assert_mean(squared, 6.0, detectable=1.0)


def test_maps_are_dealt_by_their_probabilities(key):
    """Each draw exactly; the first K together to within three of K times as many, whatever K."""
    shares = np.asarray([0.61, 0.0, 0.29, 0.1])
    runs = np.stack([dealt(one, shares, 64) for one in jax.random.split(key, 1000)])

    counts = np.stack([np.cumsum(runs == mode, axis=1) for mode in range(4)], axis=-1)
    assert (np.abs(counts - shares * np.arange(1, 65)[:, None]) < 3).all()
    assert not counts[..., 1].any()
    for mode in (0, 2, 3):
        assert_mean(runs[:, [0, 5, 63]] == mode, np.full(3, shares[mode]), detectable=0.1)
    longer = dealt(jax.random.key(1), shares, 100)
    np.testing.assert_array_equal(longer[:64], dealt(jax.random.key(1), shares, 64))


def test_equal_keys_give_equal_poses(key, tracked):
    """Refinement draws from its key alone."""
    first, second = (_refined(jax.random.clone(key), _maps(tracked), tracked) for _ in range(2))
    np.testing.assert_array_equal(first.drawn, second.drawn)
    np.testing.assert_array_equal(first.poses, second.poses)


def test_a_lone_keyframe_stays(key):
    """Without overlaps there is nothing to refine."""
    view = view_of_frame(box_room.frames(box_room.walk(1))[0], box_room.INTRINSICS)
    state, _ = init(view, 0, CONFIG)
    maps = _maps(state)
    placed = _refined(key, maps, state)

    assert placed.held.tolist() == [[True]]
    np.testing.assert_allclose(placed.sd_per_m[0], 1e-6 * np.sqrt(62 / 63), rtol=1e-4)
    np.testing.assert_array_equal(placed.poses, maps.poses)
