"""What may carry a pose that hangs in the air, in depth images of boxes."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from scene.search.support_prior import STEP_M, UNDERSIDE_M, UNDERSIDE_POINTS, gaps_to_seen, undersides
from tests.scene.table_views import TABLE, depth_of, view_of

CARRIER_M = np.array([0.0, 0.0, 0.04]), np.array([0.05, 0.05, 0.04])
"""Middle and half size of a thing that nobody knows."""
TOP_M, HALF_M = 0.08, np.array([0.03, 0.02, 0.03])


def gap_of(bottom_m: tuple[float, float, float], *, carried: bool = True, there: bool = True) -> float:
    """From a box with its underside's middle there, in an image with it or without, and with the carrier."""
    bottom = np.array(bottom_m)
    boxes = [CARRIER_M] * carried + [(bottom + HALF_M * [0, 0, 1], HALF_M)] * there
    depth_m = depth_of(boxes)
    view = replace(view_of(depth_m), unexplained=jnp.asarray(depth_m < depth_of([]) - 0.003))
    across = np.linspace(-1, 1, 5)
    corners = np.stack(np.meshgrid(across, across, [0.0], indexing="ij"), axis=-1).reshape(-1, 3) * HALF_M
    points = np.random.default_rng(0).permutation(bottom + corners)
    return float(gaps_to_seen(view, TABLE, undersides(points[None]))[0])


@pytest.mark.parametrize("gap_m", [0.0, 0.01, 0.03])
@pytest.mark.parametrize("there", [True, False])
def test_the_top_of_an_unknown_thing_is_as_far_below_as_it_is(gap_m: float, there: bool) -> None:
    """A box over a thing that stands out on all sides: to a place between those that are looked at."""
    assert gap_of((0.0, 0.0, TOP_M + gap_m), there=there) == pytest.approx(gap_m, abs=STEP_M)


@pytest.mark.parametrize("there", [True, False])
def test_nothing_carries_what_is_over_empty_space(there: bool) -> None:
    """Over the bare table, beside the thing, and in front of it as high as its middle."""
    assert np.isinf(gap_of((0.0, 0.0, TOP_M), carried=False, there=there))
    assert np.isinf(gap_of((0.15, 0.0, TOP_M), there=there))
    assert np.isinf(gap_of((0.0, -0.13, TOP_M), there=there))


def test_the_underside_is_low_and_its_lowest_point_comes_first(seed: int) -> None:
    """Of random poses, some with fewer low points than are looked below."""
    points = np.random.default_rng(seed).normal(0, 0.05, (6, 200, 3))
    points[:3, :, 2] = np.abs(points[:3, :, 2]) / 10
    lowest = points[..., 2].min(axis=1)

    found = undersides(points)

    assert found.shape == (6, UNDERSIDE_POINTS, 3)
    np.testing.assert_array_equal(found[:, 0, 2], lowest)
    assert (found[..., 2] < lowest[:, None] + UNDERSIDE_M).all()
    assert len(np.unique(found[0], axis=0)) == UNDERSIDE_POINTS
