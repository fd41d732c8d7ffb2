"""A step of the filter with several hypotheses, and the Gaussians about places."""

from dataclasses import replace
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from numpy.typing import NDArray

from recordings.types import DepthNoise
from shapes.geometry import pose_gaussian
from shapes.geometry.pose_sets import IDENTITY
from shapes.geometry.poses import matrices_of
from slam.config import SlamConfig
from slam.filter import smc
from slam.filter.init import init
from slam.filter.motion import is_wide_step
from slam.filter.places import place_at
from slam.filter.pose_hypotheses import Found, find_places, predict
from slam.filter.state import FilterState, Hypothesis
from slam.filter.step import step
from slam.keyframes.depth_view import view_of_frame
from tests.slam import box_room
from tests.statistical import assert_coverage

CONFIG = SlamConfig(noise=DepthNoise(), effective_pixel_share=0.01, second_motion=False)
POSES = np.stack([box_room.pose(0.12 * i, 0.05 * i, -0.5, 0.21 * i) for i in range(4)])
FRAMES = box_room.frames(POSES, seed=3)
VIEWS = [view_of_frame(frame, box_room.INTRINSICS) for frame in FRAMES]


@pytest.fixture(scope="module")
def tracked() -> FilterState:
    """After three frames, each a keyframe."""
    state, _ = init(VIEWS[0], FRAMES[0].time_ns, CONFIG)
    for index in (1, 2):
        state, _ = step(jax.random.key(index), state, VIEWS[index], FRAMES[index].time_ns, CONFIG)
    return state


def _moved(hypothesis: Hypothesis, by: jaxlie.SE3) -> Hypothesis:
    """All of it, rigidly."""

    def moved(poses: NDArray[np.float32]) -> NDArray[np.float32]:
        flat = [np.asarray((by @ jaxlie.SE3(jnp.asarray(pose))).wxyz_xyz) for pose in poses.reshape(-1, 7)]
        return np.stack(flat).reshape(poses.shape)

    return replace(
        hypothesis,
        keyframe_poses=moved(hypothesis.keyframe_poses),
        pose=moved(hypothesis.pose),
        previous_pose=moved(hypothesis.previous_pose),
    )


def test_hypotheses_that_differ_by_the_frame_of_reference_alone_keep_their_weights(key, tracked):
    """Each has the camera where its own map says; the evidence is that of one alone."""
    assert len(tracked.keyframe_map) == 3
    by = jaxlie.SE3.exp(jnp.asarray([0.4, -0.3, 0.2, 0.5, -0.7, 0.4]))
    one = tracked.population.heaviest
    both = replace(tracked, population=smc.Population((one, _moved(one, by)), np.log(np.asarray([0.3, 0.7]))))

    alone, info_alone = step(jax.random.clone(key), tracked, VIEWS[3], FRAMES[3].time_ns, CONFIG)
    after, info = step(key, both, VIEWS[3], FRAMES[3].time_ns, CONFIG)

    np.testing.assert_allclose(after.population.probabilities, [0.3, 0.7], atol=0.01)
    assert info.log_evidence == pytest.approx(info_alone.log_evidence, abs=0.05)
    assert info.hypotheses == pytest.approx(1 / (0.3**2 + 0.7**2), abs=0.05)
    first, second = after.population.histories
    np.testing.assert_allclose(first.pose, alone.population.heaviest.pose, atol=1e-5)
    moved = _moved(first, by)
    np.testing.assert_allclose(matrices_of(second.pose), matrices_of(moved.pose), atol=5e-4)
    assert len(second.keyframe_poses) == 4
    np.testing.assert_allclose(info.places.relative_poses[0], info.places.relative_poses[1], atol=5e-4)


def test_a_hypothesis_whose_map_disagrees_with_the_frame_loses_its_weight(key, tracked):
    """Its second keyframe stands 20 cm off, the third is right: the frame sees both."""
    one = tracked.population.heaviest
    wrong = one.keyframe_poses.copy()
    wrong[1, 4] += 0.2
    population = smc.Population((one, replace(one, keyframe_poses=wrong)), np.log(np.asarray([0.2, 0.8])))

    after, info = step(key, replace(tracked, population=population), VIEWS[3], FRAMES[3].time_ns, CONFIG)

    right = after.population.probabilities[info.places.ancestors == 0]
    assert right.sum() > 0.9


def test_a_keyframe_that_drift_may_have_brought_into_sight_does_not_mislead(tracked):
    """The first one, 20 cm off, nothing ties to the others: the frame is where these have it, and says so.

    Where it is in its place the frame is compared with it, too.
    """
    one = tracked.population.heaviest
    untied = replace(one, overlaps=np.asarray([[2, 1]], np.int32), anchor=2)
    wrong = one.keyframe_poses.copy()
    wrong[0, 4] += 0.2
    prediction = predict(tracked, FRAMES[3].time_ns)

    def found(hypothesis: Hypothesis) -> Found:
        state = replace(tracked, population=smc.certain(hypothesis))
        return find_places(state, VIEWS[3], prediction, CONFIG, None)

    right, drifted = found(untied), found(replace(untied, keyframe_poses=wrong))

    assert not right.contradicted
    assert drifted.contradicted
    assert 0 in right.best.indices
    assert 0 not in drifted.best.indices
    np.testing.assert_allclose(drifted.best.optimum.pose, right.best.optimum.pose, atol=0.003)


@pytest.mark.parametrize(("sensor_is_known", "searches"), [(True, 1), (False, 2)])
def test_only_a_frame_that_teaches_the_sensor_is_searched_again(key, monkeypatch, sensor_is_known, searches):
    """With noise and pixel exponent given there is nothing to learn; else the second frame tells of both."""
    config = CONFIG if sensor_is_known else replace(CONFIG, noise=None, effective_pixel_share=None)
    state, _ = init(VIEWS[0], FRAMES[0].time_ns, config)
    searched = Mock(side_effect=find_places)
    monkeypatch.setattr("slam.filter.step.find_places", searched)

    step(key, state, VIEWS[1], FRAMES[1].time_ns, config)

    assert searched.call_count == searches


def test_hypotheses_in_one_place_go_on_as_one(key, tracked):
    """With the weight of both."""
    one = tracked.population.heaviest
    population = smc.Population((one, one), np.log(np.asarray([0.2, 0.8])))

    after, _ = step(key, replace(tracked, population=population), VIEWS[3], FRAMES[3].time_ns, CONFIG)

    np.testing.assert_allclose(after.population.probabilities, [1.0])


def test_a_frame_that_shows_nothing_leaves_hypotheses_and_weights(key, tracked):
    """It is lost in all of them."""
    by = jaxlie.SE3.exp(jnp.asarray([0.4, -0.3, 0.2, 0.5, -0.7, 0.4]))
    one = tracked.population.heaviest
    population = smc.Population((one, _moved(one, by)), np.log(np.asarray([0.3, 0.7])))
    blank = replace(FRAMES[3], depth_m=np.zeros_like(FRAMES[3].depth_m))
    view = view_of_frame(blank, box_room.INTRINSICS)

    after, info = step(key, replace(tracked, population=population), view, FRAMES[3].time_ns, CONFIG)

    assert info.lost
    np.testing.assert_allclose(after.population.probabilities, [0.3, 0.7])
    np.testing.assert_array_equal(after.population.histories[1].pose, population.histories[1].pose)


@pytest.mark.parametrize("columns", [slice(60, 76), slice(140, None)])
def test_returns_beyond_the_range_of_the_sensor_lose_no_frame(key, tracked, columns):
    """An open door, where the map shows a wall or nothing yet: a sensor that returns 14 m reaches so far."""
    depth = FRAMES[3].depth_m.copy()
    depth[20:100, columns] = 14.0
    view = view_of_frame(replace(FRAMES[3], depth_m=depth), box_room.INTRINSICS)

    after, info = step(key, tracked, view, FRAMES[3].time_ns, CONFIG)

    assert not info.lost
    assert info.log_evidence > -1e3
    assert after.calibration.noise.max_range_m == 14.0


def test_velocity_is_of_the_frames_that_were_found(key, tracked):
    """After frames that were lost the motion spans them all, and the next step is one of as many."""
    blank = replace(FRAMES[3], depth_m=np.zeros_like(FRAMES[3].depth_m))
    view = view_of_frame(blank, box_room.INTRINSICS)
    interval, last = FRAMES[2].time_ns - FRAMES[1].time_ns, FRAMES[2].time_ns
    state = tracked
    for lost in (1, 2):
        state, info = step(jax.random.key(lost), state, view, last + lost * interval, CONFIG)
        assert info.lost
    np.testing.assert_array_equal(
        predict(state, last + 3 * interval).poses[0], state.population.heaviest.pose
    )

    state, info = step(key, state, VIEWS[3], last + 3 * interval, CONFIG)

    assert not info.lost
    one, expected = state.population.heaviest, predict(state, last + 4 * interval).poses[0]
    before, after = jnp.asarray(one.previous_pose), jnp.asarray(one.pose)
    third = pose_gaussian.displace(after, pose_gaussian.coordinates(before, after) / 3)
    np.testing.assert_allclose(expected, third, atol=1e-5)


def test_a_place_is_a_gaussian_also_where_pixels_tell_nothing_of_a_direction(tracked):
    """Precisions are added, and one that rounding left negative, beside one of 1e10, holds nothing."""
    prediction = predict(tracked, FRAMES[3].time_ns)
    ((located,),) = find_places(tracked, VIEWS[3], prediction, CONFIG, None).of_hypotheses
    one = tracked.population.heaviest
    past = tracked.past_of(one, prediction.poses[0])
    known = np.diag([1e10, 4e5, 2e5, 1e6, 1e6, -1e3])
    layers = jnp.asarray(np.stack([known, *[0 * known] * 3]), jnp.float32)
    optimum = replace(located.optimum, layer_precisions=layers)
    jerk = 1.0 / 0.15**2

    place = place_at(optimum, located.local_map, past, tracked.motion, 0.5)

    seen = 0.5 * np.diag(np.maximum(known, 0.0))
    np.testing.assert_allclose(np.diag(np.linalg.inv(place.covariance))[:3], seen[:3] + jerk, rtol=0.05)
    assert (np.linalg.eigvalsh(place.covariance) > 0).all()
    assert place.covariance[5, 5] == pytest.approx(0.15**2, rel=0.1)


def test_evidence_of_a_place_is_the_integral_of_image_and_motion(tracked):
    """Of Gaussians: the image's volume, times N(optimum; last pose, covariances of the image and a jerk).

    One direction is not held by pixels, 30 cm from where the camera was: there motion alone decides.
    Gaussians of translations are exact; the tolerance is for sums in single precision.
    """
    prediction = predict(tracked, FRAMES[3].time_ns)
    ((located,),) = find_places(tracked, VIEWS[3], prediction, CONFIG, None).of_hypotheses
    one = tracked.population.heaviest
    away = np.asarray([0.3, 0.1, 0.05, 0.0, 0.0, 0.0], np.float32)
    known = np.diag([1e-6, 400.0, 100.0, 1e6, 1e6, 1e6])
    optimum = replace(
        located.optimum,
        pose=pose_gaussian.displace(jnp.asarray(one.pose), jnp.asarray(away)),
        layer_precisions=jnp.asarray(np.stack([known, *[0 * known] * 3]), jnp.float32),
    )
    jerks = replace(tracked.motion, log_shares=jnp.asarray([-1e3, 0.0, -1e3]))

    place = place_at(optimum, located.local_map, tracked.past_of(one, one.pose), jerks, 1.0)

    of_image = 3 * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(known)[1]
    spread = np.linalg.inv(known) + 0.15**2 * np.eye(6)
    met = -0.5 * away @ np.linalg.solve(spread, away) - 0.5 * np.linalg.slogdet(2 * np.pi * spread)[1]
    expected = float(optimum.log_density) + of_image + met
    assert place.log_evidence == pytest.approx(expected, abs=0.01)


def test_narrow_steps_are_no_reason_to_look_again():
    """Twelve degrees round a room are not wide, nor are most jerks; a fifth of a circle is."""

    def step_of(*tangent: float) -> NDArray[np.float32]:
        return np.asarray(pose_gaussian.displace(here, jnp.asarray(tangent, jnp.float32)))

    here = jnp.asarray(IDENTITY, jnp.float32)
    jerks = 0.15 * np.random.default_rng(0).normal(size=(400, 6))
    wide = [is_wide_step(np.asarray(here), step_of(*jerk)) for jerk in jerks]

    assert not is_wide_step(np.asarray(here), step_of(0.31, 0.0, 0.0, 0.0, 0.21, 0.0))
    assert is_wide_step(np.asarray(here), step_of(0.0, 0.0, 0.0, 0.0, np.radians(72), 0.0))
    assert is_wide_step(np.asarray(here), step_of(0.47, 0.0, 0.0, 0.0, 0.31, 0.0))
    assert_coverage(sum(wide), len(wide), 0.05)
