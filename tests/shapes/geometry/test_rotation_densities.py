from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pipeline.benchmarks.cubes import cube_model
from scene.mcmc import pose_mixture
from scene.mcmc.pose_mixture import PoseMixture
from scene.model.prior import eta_density
from shapes.geometry.rotation_densities import (
    LOG_ROTATION_MASS,
    log_gaussian_pose,
    uniform_rotation,
    von_mises_fisher,
    von_mises_fisher_direction,
)
from tests.statistical import assert_frequencies, assert_mean

pytestmark = pytest.mark.usefixtures("double_precision")


@pytest.mark.parametrize("concentration", [0.5, 10.0, 800.0])
def test_von_mises_fisher_integrates_to_one(concentration: float) -> None:
    """Over the cosine, times 2 pi."""
    edges = 1 - jnp.geomspace(1e-9, 2.0, 200_001)
    middles = (edges[1:] + edges[:-1]) / 2
    density = von_mises_fisher(jnp.array(concentration), middles)

    np.testing.assert_allclose(2 * jnp.pi * jnp.sum(density * -jnp.diff(edges)), 1.0, atol=1e-6)


def test_eta_density_with_slack_integrates_to_one() -> None:
    """The mixture of flush contact and a uniform hemisphere."""
    cosines = jnp.linspace(-1, 1, 200_001)
    middles = (cosines[1:] + cosines[:-1]) / 2
    density = eta_density(cube_model(2, slack_share=0.3).prior, middles)

    np.testing.assert_allclose(2 * jnp.pi * jnp.sum(density) * 1e-5, 1.0, atol=1e-5)


def test_von_mises_fisher_agrees_with_its_sampler(key: jax.Array) -> None:
    """Draws fall into bands of the sphere as the density says, all round."""
    uniforms = jax.random.uniform(key, (100_000, 2))
    draws = jax.vmap(lambda u: von_mises_fisher_direction(jnp.array(5.0), u))(uniforms)
    edges = np.linspace(-1, 1, 9)
    cumulative = (np.exp(5 * edges) - np.exp(-5)) / (np.exp(5) - np.exp(-5))
    keep = np.diff(cumulative) > 1e-3
    counts = np.histogram(draws[:, 2], edges)[0]
    quadrants = np.histogram(np.arctan2(draws[:, 1], draws[:, 0]), 4, (-np.pi, np.pi))[0]

    shares = np.append(np.diff(cumulative)[keep], np.diff(cumulative)[~keep].sum())
    assert_frequencies(np.append(counts[keep], counts[~keep].sum()), shares)
    assert_frequencies(quadrants, np.full(4, 0.25))


@pytest.mark.parametrize("spread_rad", [0.3, 0.9])
def test_gaussian_pose_integrates_to_one(key: jax.Array, spread_rad: float) -> None:
    """Mean of the rotation density over Haar draws, times pi^2, the windings included."""
    factor = jnp.diag(jnp.array([1.0, 1, 1, spread_rad, spread_rad, spread_rad])).at[4, 3].set(0.2)
    whitening = jnp.linalg.inv(factor)
    rotations = jax.vmap(uniform_rotation)(jax.random.uniform(key, (400_000, 3)))
    at_origin = jax.jit(jax.vmap(partial(log_gaussian_pose, whitening, jnp.zeros(3))))(rotations)
    log_translation = -1.5 * jnp.log(2 * jnp.pi)

    assert_mean(jnp.exp(at_origin - log_translation + LOG_ROTATION_MASS), 1.0, detectable=0.1)


def test_pose_mixture_agrees_with_its_sampler(key: jax.Array) -> None:
    """For draws from a mixture, E[f / density] is the integral of f: the volume of a box times all turns."""
    uniform_key, normal_key = jax.random.split(key)
    centres = jnp.array([[[1.0, 0, 0, 0, 0, 0, 0], [0.6, 0.8, 0, 0, 0.3, 0, 0]]])
    covariances = jnp.stack([jnp.eye(6) * 0.5, jnp.diag(jnp.array([0.2, 0.3, 0.4, 0.9, 0.9, 0.9]) ** 2)])[
        None
    ]
    mixture = PoseMixture.build(jnp.log(jnp.array([[3.0, 1.0]])), centres, covariances).of(jnp.array(0))
    uniforms = jax.random.uniform(uniform_key, (300_000,))
    normals = jax.random.normal(normal_key, (300_000, 6))
    poses = jax.jit(jax.vmap(pose_mixture.sample, in_axes=(0, 0, None)))(uniforms, normals, mixture)
    inside = jnp.all(jnp.abs(poses[:, 4:]) < 0.5, axis=1)
    log_density = jax.jit(jax.vmap(pose_mixture.log_density, in_axes=(None, 0)))(mixture, poses)

    assert_mean(jnp.where(inside, jnp.exp(-log_density), 0.0), jnp.pi**2, detectable=1.0)
