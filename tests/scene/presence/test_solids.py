"""Unknown solids: how they are seen, and the density that they are drawn from."""

from types import SimpleNamespace
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scene.presence.posterior import Births, _log_offered
from scene.presence.solids import (
    GREATEST_M,
    LEAST_M,
    SolidFits,
    _cropped_layers,
    log_sizes_density,
    solid_half_sizes,
    solid_layers,
)
from scene.presence.state_mixture import StateMixture
from shapes.geometry.camera import Camera
from tests.statistical import assert_mean

HEIGHT, WIDTH = 24, 32
CAMERA = Camera(*(jnp.float32(value) for value in (40.0, 40.0, 15.5, 11.5)))
HALF_M = np.array([[0.1, 0.06, 0.15], [0.1, 0.1, 0.12]])


def inside(points_m: np.ndarray, half_m: np.ndarray, is_round: bool, slack_m: float) -> np.ndarray:
    """Whether points (n, 3) in a solid's own frame are inside it, grown by so much."""
    flat = np.abs(points_m[:, 2]) < half_m[2] + slack_m
    if is_round:
        return flat & (np.linalg.norm(points_m[:, :2], axis=1) < half_m[0] + slack_m)
    return flat & (np.abs(points_m[:, :2]) < half_m[:2] + slack_m).all(axis=1)


def test_crops_show_what_the_whole_image_does(seed: int) -> None:
    """Solids near and far, across the borders, beside the image, behind and about the camera.

    Rays that graze a solid are told to a tenth of a millimetre, and may miss it: one of 100,000.
    """
    rng, count, height, width = np.random.default_rng(seed), 200, 96, 128
    camera = Camera(*(jnp.float32(value) for value in (140.0, 140.0, 63.5, 47.5)))
    wxyz = Rotation.random(count, rng=rng).as_quat(scalar_first=True)
    places_m = rng.uniform([-0.6, -0.5, -0.2], [0.6, 0.5, 1.5], (count, 3))
    poses = np.concatenate([wxyz, places_m], axis=1)
    half_m, is_round = np.exp(rng.uniform(-5, -1.5, (count, 3))), rng.random(count) < 0.5
    half_m[is_round, 1] = half_m[is_round, 0]
    seen = solid_layers(camera, poses, half_m, is_round, height, width)
    given = poses.astype(np.float32), half_m.astype(np.float32), is_round, np.zeros((count, 2), np.int32)
    whole = np.asarray(_cropped_layers(camera, *given, height, width))

    assert 0.1 < np.isfinite(whole).any(axis=(1, 2)).mean() < 0.9
    assert (np.isfinite(seen) != np.isfinite(whole)).mean() < 1e-5
    both = np.isfinite(seen) & np.isfinite(whole)
    np.testing.assert_allclose(seen[both], whole[both], atol=1e-4)


@pytest.mark.parametrize("is_round", [False, True])
def test_a_solid_is_seen_where_rays_enter_it(is_round: bool, seed: int) -> None:
    """Points seen lie on it to 0.1 mm, nothing nearer on their rays is inside, other rays miss it."""
    rotation = Rotation.random(rng=np.random.default_rng(seed))
    pose = np.concatenate([rotation.as_quat(scalar_first=True), [0.02, -0.03, 0.8]])
    half_m = HALF_M[int(is_round)]
    layer = solid_layers(CAMERA, pose[None], half_m[None], np.array([is_round]), HEIGHT, WIDTH)[0]
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(columns - 15.5) / 40, (rows - 11.5) / 40, np.ones_like(rows)], axis=-1)

    def own(depth_m: np.ndarray) -> np.ndarray:
        return rotation.inv().apply((rays * depth_m[..., None]).reshape(-1, 3) - pose[4:])

    seen = np.isfinite(layer)
    assert seen.sum() > 40
    at = own(np.where(seen, layer, 0.0))[seen.ravel()]
    assert inside(at, half_m, is_round, 1e-4).all()
    assert not inside(at, half_m, is_round, -1e-4).any()
    for depth in np.linspace(0.4, 1.2, 200):
        before = np.where(seen, depth < layer - 1e-3, True).ravel()
        assert not inside(own(np.full(layer.shape, depth)), half_m, is_round, -1e-3)[before].any()


@pytest.mark.parametrize("is_round", [False, True])
def test_the_density_is_that_of_the_draws(is_round: bool, seed: int) -> None:
    """The mean over draws of a wider density's ratio to that of the draws is 1, spins and sizes included."""
    rng = np.random.default_rng(seed)
    centre = np.concatenate([[1.0, 0, 0, 0, 0.3, 0.1, 0.2], np.log(HALF_M[int(is_round)])])[None]
    mixed = np.diag(np.repeat([0.01, 0.03, 0.02], 3)) + 0.004 * np.tril(rng.standard_normal((9, 9)), -1)
    drawn_from = SolidFits(is_round=np.array([is_round]), centres=centre, factors=mixed[None])
    narrower = SolidFits(is_round=np.array([is_round]), centres=centre, factors=0.8 * mixed[None])
    states = drawn_from.drawn(rng, 20_000)

    ratio = np.exp(
        narrower.log_density(states, narrower.is_round) - drawn_from.log_density(states, drawn_from.is_round)
    )[0]

    assert_mean(ratio, 1.0, detectable=0.1)


@pytest.mark.parametrize("is_round", [False, True])
def test_the_density_counts_every_telling_once(is_round: bool, seed: int) -> None:
    """Its integral over rotations of mass pi^2 is the number of ways in which a solid is told.

    Turns are as wide as half a radian, where the chart's volume element counts: without it 6% are missing.
    """
    rng = np.random.default_rng(seed)
    half_m = np.array([0.1, 0.1, 0.1])
    centre = np.concatenate([[1.0, 0, 0, 0, 0.3, 0.1, 0.2], np.log(half_m)])[None]
    factor = np.diag(np.repeat([0.01, 0.5, 0.02], 3))
    fits = SolidFits(is_round=np.array([is_round]), centres=centre, factors=factor[None])
    states = np.repeat(centre[:, None], 80_000, axis=1)
    states[..., :4] = Rotation.random(80_000, rng=rng).as_quat(scalar_first=True)

    free = 5 if is_round else 6  # of place and sizes, at the peak of whose Gaussian all states are
    log_peak = -3 * np.log(0.01) - (free - 3) * np.log(0.02) - free / 2 * np.log(2 * np.pi)
    mass = np.pi**2 * np.exp(fits.log_density(states, fits.is_round) - log_peak)[0]

    assert_mean(mass, 2.0 if is_round else 24.0, detectable=0.05 if is_round else 0.6)


def test_one_box_told_in_two_ways_is_the_same(seed: int) -> None:
    """Two Gaussians on it, one of which has its axes exchanged, weigh twice as much as one."""
    rng = np.random.default_rng(seed)
    centre = np.concatenate([[1.0, 0, 0, 0, 0.3, 0.1, 0.2], np.log(HALF_M[0])])
    quarter = Rotation.from_rotvec([0, 0, np.pi / 2])
    turned = np.concatenate([quarter.as_quat(scalar_first=True), centre[4:7], centre[[8, 7, 9]]])
    factors = np.tile(np.diag(np.repeat([0.01, 0.03, 0.02], 3)), (2, 1, 1))
    one = SolidFits(is_round=np.array([False]), centres=centre[None], factors=factors[:1])
    two = SolidFits(is_round=np.zeros(2, bool), centres=np.stack([centre, turned]), factors=factors)
    states = two.drawn(rng, 50)

    in_each = [one.log_density(states[at : at + 1], one.is_round)[0] for at in (0, 1)]

    np.testing.assert_allclose(
        two.log_density(states, two.is_round), np.log(2) + np.stack(in_each), atol=1e-3
    )


@pytest.mark.filterwarnings("error")
def test_sizes_without_a_prior_are_seen_at_its_bounds() -> None:
    """Draws of a fit to nothing may have sizes whose exponentials overflow."""
    states = np.array([[1.0, 0, 0, 0, 0, 0, 0, 1e4, -1e4, np.log(0.05)]])
    np.testing.assert_allclose(solid_half_sizes(states), [[GREATEST_M, LEAST_M, 0.05]])
    assert log_sizes_density(states[:, 7:], np.array([False])) == -np.inf


def test_densities_of_what_stays_are_kept(seed: int) -> None:
    """Of two objects and three solids two are drawn anew: their densities alone change, to what all have."""
    rng = np.random.default_rng(seed)
    factors = np.tile(np.diag(np.repeat([0.01, 0.03, 0.02], 3)), (5, 1, 1))
    centres = np.concatenate(
        [np.tile([1.0, 0, 0, 0, 0.3, 0.1, 0.2], (5, 1)), np.log([HALF_M[0]] * 5)], axis=1
    )
    solids = SolidFits(is_round=np.array([True, False, True]), centres=centres[2:], factors=factors[2:])
    mixture = StateMixture(
        log_weights=np.zeros((2, 1)),
        centres=centres[:2, None],
        factors=factors[:2, None],
        points_m=np.zeros((2, 3)),
        ties=np.tile(np.arange(3), (2, 1)),
    )
    states = np.concatenate([mixture.drawn(rng, 6), solids.drawn(rng, 6)])
    before = cast("Any", SimpleNamespace(candidates=SimpleNamespace(log_offered=np.full((5, 6), 7.0))))
    anew = np.array([False, True, True, False, False])

    births = Births(mixture=mixture, solids=solids)
    every = _log_offered(births, states, None, np.ones(5, bool))
    some = _log_offered(births, states, before, anew)

    of_solids = solids.log_density(states[2:], solids.is_round)
    np.testing.assert_array_equal(every, np.concatenate([mixture.log_density(states[:2]), of_solids]))
    np.testing.assert_allclose(some, np.where(anew[:, None], every, 7.0))
