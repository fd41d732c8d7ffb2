"""Expectation propagation against exact enumeration (docs/model.md, section I)."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

from recordings.types import NO_RETURN, DepthNoise
from shapes.depth_noise import log_density_of_hit, log_density_of_miss
from shapes.learning.expectation_propagation import SensorRays, VoxelStates, voxel_states

SENSOR = DepthNoise(sigma_base_m=1.0, sigma_growth_per_m=0.0, none_hit_probability=0.02, max_range_m=20.0)


def rays_of(
    voxel: Any, association: Any, density: Any, miss: Any, side: Any = None, before: Any = None
) -> SensorRays:
    """Whole rays for which all voxels look alike from both sides, unless the sides are given."""
    voxel, miss = jnp.asarray(voxel), jnp.asarray(miss)
    side = jnp.zeros_like(voxel) if side is None else jnp.asarray(side)
    before = jnp.zeros_like(miss) if before is None else jnp.asarray(before)
    return SensorRays(voxel, jnp.asarray(association), jnp.asarray(density), before, miss, side)


def exact_marginals(rays: SensorRays, prior: NDArray[np.float64]) -> NDArray[np.float64]:
    """p(O_v = 1 | all rays) by summing over every state; a ray's density is that of the forward model."""
    leaves = (rays.voxel, rays.density, rays.before, rays.miss)
    voxel, density, before, miss = (np.asarray(leaf) for leaf in leaves)
    states = np.array(list(itertools.product([0, 1], repeat=len(prior))))
    log_weight = (np.log(prior) * states + np.log1p(-prior) * (1 - states)).sum(axis=1)
    for line, values, ended, missed in zip(voxel, density, before, miss, strict=True):
        passed = line < len(prior)
        on_ray = states[:, line[passed]]
        first = np.where(on_ray.any(axis=1), on_ray.argmax(axis=1), -1)
        log_weight += np.log(ended + np.append(values[passed], missed)[first])
    weight = np.exp(log_weight - log_weight.max())
    return weight @ states / weight.sum()


def binary_states(rays: SensorRays, prior: NDArray[np.float64], **options: Any) -> VoxelStates:
    """Voxels that are occupied or empty."""
    log_prior = jnp.log(jnp.stack([prior, 1 - prior], axis=-1))
    return voxel_states(rays, log_prior, jnp.asarray([[1.0, 0.0]]), **options)


def measured_ray(line: list[int], truth: NDArray[np.int_], rng: np.random.Generator) -> tuple:
    """Densities of one noisy measurement along a line of voxels whose pitch is one."""
    at = np.arange(1.0, len(line) + 1)
    occupied = np.flatnonzero(truth[line])
    measured: float
    if rng.random() < SENSOR.none_hit_probability:
        measured = NO_RETURN
    elif len(occupied) == 0:
        measured = NO_RETURN if rng.random() < SENSOR.none_miss_probability else rng.uniform(0, 20)
    else:
        measured = max(float(at[occupied[0]] + SENSOR.sigma_base_m * rng.normal()), NO_RETURN)
    density = np.exp(log_density_of_hit(SENSOR, jnp.full(len(line), measured), jnp.asarray(at)))
    return np.asarray(density), float(np.exp(log_density_of_miss(SENSOR, jnp.asarray(measured))))


@pytest.mark.parametrize("ended", [0.0, 0.3])
def test_one_ray_is_exact(seed: int, ended: float) -> None:
    """Two undamped sweeps give the sums over all states of up to ten voxels, of a part of a ray too."""
    rng = np.random.default_rng(seed)
    with jax.enable_x64(True):
        for count in (1, 2, 5, 10):
            prior = rng.uniform(0.05, 0.95, count)
            truth = (rng.random(count) < prior).astype(int)
            density, miss = measured_ray(list(range(count)), truth, rng)
            rays = rays_of(
                jnp.arange(count)[None], jnp.ones((1, count)), density[None], [miss], before=[ended]
            )
            got = binary_states(rays, prior, damping=1.0, sweeps=2).probability[:, 0]
            np.testing.assert_allclose(got, exact_marginals(rays, prior), atol=1e-9)


def test_padding_and_rays_that_pass_by_change_nothing(seed: int) -> None:
    """Unused places, and voxels that a ray surely misses, leave every marginal where it was."""
    rng = np.random.default_rng(seed)
    with jax.enable_x64(True):
        density = jnp.asarray(rng.uniform(0.1, 1.0, (1, 3)))
        alone = rays_of(jnp.arange(3)[None], jnp.ones((1, 3)), density, jnp.asarray([0.3]))
        padded = rays_of(
            jnp.asarray([[0, 1, 2, 4], [4, 4, 4, 4], [3, 4, 4, 4]]),
            jnp.asarray([[1.0, 1, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0]]),
            jnp.concatenate([jnp.pad(density, ((0, 0), (0, 1))), jnp.ones((2, 4))]),
            jnp.asarray([0.3, 1.0, 0.7]),
        )
        short = binary_states(alone, np.full(4, 0.4))
        long = binary_states(padded, np.full(4, 0.4))
    np.testing.assert_allclose(short.probability, long.probability, atol=1e-12)
    np.testing.assert_allclose(long.probability[3], [0.4, 0.6], atol=1e-12)
    assert float(long.reach[3]) == 0.0


def test_a_ray_reaches_up_to_where_it_ends() -> None:
    """Voxels before the end are free, those behind keep their prior and are not reached."""
    rays = rays_of(
        jnp.arange(5)[None],
        jnp.ones((1, 5)),
        jnp.asarray([[1e-6, 1e-6, 1.0, 1e-6, 1e-6]]),
        jnp.asarray([1e-6]),
    )
    found = binary_states(rays, np.full(5, 0.5))
    np.testing.assert_allclose(found.reach, [1, 1, 1, 0, 0], atol=1e-4)
    np.testing.assert_allclose(found.probability[:, 0], [0, 0, 1, 0.5, 0.5], atol=1e-4)


def test_a_state_that_stops_half_of_the_rays_explains_rays_that_disagree() -> None:
    """Of two rays through one voxel one ends there and one passes: neither occupied nor empty."""
    stops, passes = [1.0, 1e-6], [1e-6, 1.0]
    rays = rays_of(
        jnp.asarray([[0, 1]] * 2), jnp.ones((2, 2)), jnp.asarray([stops, passes]), jnp.full(2, 1e-6)
    )
    log_prior = jnp.log(jnp.asarray([[0.4, 0.2, 0.4]] * 2))
    found = voxel_states(rays, log_prior, jnp.asarray([[1.0, 0.5, 0.0]])).probability
    np.testing.assert_allclose(found[0], [0, 1, 0], atol=1e-3)


def test_a_thin_wall_before_a_free_centre_explains_rays_from_both_sides() -> None:
    """Rays from one side end at the voxel, those from the other pass: neither occupied nor empty."""
    stops, passes = [1.0, 1e-6], [1e-6, 1.0]
    rays = rays_of(
        [[0, 1], [0, 1], [0, 2], [0, 2]],
        jnp.ones((4, 2)),
        [stops, stops, passes, passes],
        jnp.full(4, 1e-6),
        [[0, 0], [0, 0], [1, 0], [1, 0]],
    )
    log_prior = jnp.log(jnp.asarray([[0.5, 0.05, 0.05, 0.4]] * 3))
    opacity = jnp.asarray([[1.0, 1.0, 0.0, 0.0], [1.0, 0.0, 1.0, 0.0]])
    found = voxel_states(rays, log_prior, opacity).probability
    np.testing.assert_allclose(found[0], [0, 1, 0, 0], atol=1e-3)


def test_an_open_state_without_prior_mass_changes_nothing(seed: int) -> None:
    """Three states, of which one has no prior mass, are two."""
    rng = np.random.default_rng(seed)
    density = jnp.asarray(rng.uniform(0.1, 1.0, (3, 4)), jnp.float32)
    rays = rays_of(jnp.asarray(GRID[:3]), jnp.ones((3, 4)), density, jnp.full(3, 0.2))
    prior = jnp.asarray(rng.uniform(0.1, 0.9, 12), jnp.float32)
    log_prior = jnp.stack([jnp.log(prior), jnp.full(12, -80.0), jnp.log1p(-prior)], axis=-1)
    three = voxel_states(rays, log_prior, jnp.asarray([[1.0, 0.5, 0.0]])).probability[:, 0]
    two = binary_states(rays, np.asarray(prior)).probability[:, 0]
    np.testing.assert_allclose(three, two, atol=1e-5)


SPARSE = (0.1, 0.2)
"""Priors of scenes that are mostly empty, as before a sensor: rays end deep inside, or pass through."""
DENSE = 0.5
"""What learning starts from. Where two rays pass the same voxels, from the two ends of a line, their sites
count each other's doubt twice: the largest error is then 0.17, whatever damping and sweeps. Rays that cross
without running along each other, as those of different views do, stay near the exact marginals."""
GRID = np.arange(16).reshape(4, 4)
LINES = [
    *(list(line) for row in (*GRID, *GRID.T) for line in (row, row[::-1])),
    list(GRID.diagonal()),
    list(GRID[::-1].diagonal()),
]
"""Rows and columns both ways and the two diagonals: 18 crossing rays."""
ONE_WAY = [*(list(line) for line in (*GRID, *GRID.T[:, ::-1])), *LINES[-2:]]
"""Each line once, rows from the left and columns from below: 10 crossing rays."""


@pytest.fixture(scope="module")
def crossing_scenes(request: pytest.FixtureRequest) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Exact marginals and ours of 20 scenes, sigma of one voxel, for a prior and lines."""
    rng = np.random.default_rng(20)
    one, lines = request.param
    prior = np.full(16, one)
    scenes = []
    with jax.enable_x64(True):
        for _ in range(20):
            truth = (rng.random(16) < prior).astype(int)
            measured = [measured_ray(line, truth, rng) for line in lines]
            rays = rays_of(
                jnp.asarray(lines),
                jnp.ones((len(lines), 4)),
                jnp.asarray([density for density, _ in measured]),
                jnp.asarray([miss for _, miss in measured]),
            )
            ours = np.asarray(binary_states(rays, prior).probability[:, 0])
            scenes.append((exact_marginals(rays, prior), ours))
    return scenes


NEAR_EXACT = [(SPARSE[0], LINES), (SPARSE[1], LINES), (DENSE, ONE_WAY)]


@pytest.mark.parametrize("crossing_scenes", NEAR_EXACT, indirect=True)
def test_crossing_rays_are_near_the_exact_marginals(crossing_scenes: list) -> None:
    """Mean over the scenes of the largest error in phi."""
    errors = [np.abs(ours - exact).max() for exact, ours in crossing_scenes]
    assert np.mean(errors) <= 0.1


@pytest.mark.parametrize("crossing_scenes", [*NEAR_EXACT, (DENSE, LINES)], indirect=True)
def test_crossing_rays_lose_little_against_the_exact_marginals(crossing_scenes: list) -> None:
    """Log loss expected under the exact marginals, which the draw of the truth does not blur."""

    def log_loss(exact: NDArray[np.float64], phi: NDArray[np.float64]) -> float:
        phi = np.clip(phi, 1e-3, 1 - 1e-3)
        return float(-(exact * np.log(phi) + (1 - exact) * np.log1p(-phi)).mean())

    excess = [log_loss(exact, ours) - log_loss(exact, exact) for exact, ours in crossing_scenes]
    assert np.mean(excess) <= 0.02
