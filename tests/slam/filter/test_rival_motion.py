"""What a second motion leaves open of later frames, on views whose poses are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

from recordings.types import DepthNoise, Frame
from shapes.geometry import pose_gaussian
from shapes.geometry.poses import single_precision_poses
from slam.filter.rival_motion import BENT, Doubt, RivalMotion, _judged, doubt_of_frame
from slam.keyframes.depth_view import CanvasView, view_of_frame
from slam.keyframes.surfels import surfel_image
from slam.likelihood.noise_calibration import NoiseCalibration
from slam.registration.second_motion import TwoMotions
from tests.slam import box_room

NOISE = DepthNoise()
START = box_room.pose(0.0, 0.0, -0.5)
ASIDE = np.zeros((6, 8), np.float32)
ASIDE[0, 0] = 0.03
"""Three centimetres, the one displacement of a keyframe in doubt."""


def _view(pose: NDArray[np.float64], seed: int) -> CanvasView:
    depth = box_room.noisy(box_room.depth_image(pose), np.random.default_rng(seed))
    return view_of_frame(Frame(time_ns=0, depth_m=depth), box_room.INTRINSICS)


def _in_start(pose: NDArray[np.float64]) -> jax.Array:
    return jnp.asarray(single_precision_poses(np.linalg.inv(START) @ pose))


def _after_a_keyframe_in_doubt(start_doubt: NDArray[np.float32]) -> tuple[RivalMotion, jax.Array]:
    """The first keyframe, and a second one of which an image said that another motion explains it."""
    first = RivalMotion.since(surfel_image(_view(START, 1), NOISE))
    first = RivalMotion(first.reference, first.pose, start_doubt, first.second, (start_doubt,))
    beside = _in_start(box_room.pose(0.02, 0.01, -0.48, 0.01))
    surface = surfel_image(_view(box_room.pose(0.02, 0.01, -0.48, 0.01), 2), NOISE)
    return first.with_keyframe(surface, beside, Doubt(ASIDE, 0.2)), beside


@pytest.mark.parametrize(("of_start", "turned"), [(0.0, 0.02), (0.01, 0.02), (0.0, 0.6)])
def test_doubt_ends_where_the_earlier_view_explains_the_next_frame(of_start: float, turned: float) -> None:
    """It says no second motion: frame and keyframe have the earlier view's doubt alone, as its size says.

    After a turn by 0.6 rad it explains two fifths, too little to begin a doubt.
    """
    rival, beside = _after_a_keyframe_in_doubt(of_start / 0.03 * ASIDE)
    calibration, later = NoiseCalibration.initial(NOISE, None), box_room.pose(0.03, 0.02, -0.47, turned)

    rival, doubt = doubt_of_frame(rival, _view(later, 3), calibration, _in_start(later), 1, beside)

    assert doubt.rival_share == 0
    assert doubt.shift_m == pytest.approx(of_start, abs=1e-6)
    assert np.linalg.norm(rival.of_keyframes[1][:3]) == pytest.approx(of_start, abs=1e-6)


def test_doubt_stays_where_the_earlier_view_says_nothing() -> None:
    """It looks the other way: the frame shares what its keyframe is in doubt of."""
    rival, beside = _after_a_keyframe_in_doubt(np.zeros_like(ASIDE))
    away = box_room.pose(0.0, 0.0, -0.5, np.pi)
    calibration = NoiseCalibration.initial(NOISE, None)

    kept, doubt = doubt_of_frame(rival, _view(away, 4), calibration, _in_start(away), 1, beside)

    assert doubt.shift_m >= 0.03
    np.testing.assert_array_equal(kept.of_keyframes[1], ASIDE)


def test_what_two_motions_leave_open_is_the_second_moment_of_both(seed: int) -> None:
    """Each is right with its share: sum p d d' + p C of the other one, a quarter of whose step may bend."""
    rng = np.random.default_rng(seed)
    first = _in_start(START)
    step = np.asarray([0.04, -0.02, 0.01, 0.02, 0.0, -0.03])
    factor = 0.01 * rng.normal(size=(6, 6))
    two = TwoMotions(
        poses=jnp.stack([first, pose_gaussian.displace(first, jnp.asarray(step, jnp.float32))]),
        covariances=jnp.asarray(np.stack([0 * factor, factor @ factor.T]), jnp.float32),
        shares=jnp.asarray([0.45, 0.3]),
        explained=jnp.asarray(0.75),
        log_odds=jnp.asarray(9.0),
    )

    displacements, share, _ = _judged(two, first, jnp.zeros((6, 8)))

    size = np.repeat(np.linalg.norm(step.reshape(2, 3), axis=1), 3)
    of_other = factor @ factor.T + np.diag((BENT * size) ** 2)
    expected = 0.4 * (np.outer(step, step) + of_other)
    np.testing.assert_allclose(displacements @ displacements.T, expected, atol=2e-7)
    assert float(share) == pytest.approx(0.3)
