"""What chains are offered, and what they learn in their burn-in."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from scene.mcmc import pose_mixture
from scene.mcmc.mixture_adaptation import adapt_mixture
from scene.mcmc.mixture_init import MODES, own_components, spin
from scene.mcmc.pose_mixture import PoseMixture, place_of
from scene.mcmc.symmetry_arrays import SpinLines

MEAN = np.array([0.8, 0.36, 0.48, 0.0, 0.1, -0.2, 0.5])


NOT_ROUND = SpinLines(jnp.zeros(3), jnp.zeros(3), jnp.array(False))
ROUND = SpinLines(jnp.array([0.6, 0.0, 0.8]), jnp.array([0.004, 0.012, -0.003]), jnp.array(True))
"""About a line beside the box's middle, along none of its axes."""


def covariance(seed: int) -> jax.Array:
    """A strongly correlated one, of millimetres and hundredths of a radian."""
    factor = np.random.default_rng(seed).normal(size=(6, 6)) * np.repeat([0.001, 0.01], 3)[:, None]
    return jnp.asarray(factor @ factor.T + 1e-8 * np.eye(6))


@partial(jax.jit, static_argnames="count")
def samples(key: jax.Array, mixture: PoseMixture, count: int) -> jax.Array:
    """Poses (count, 7)."""
    uniform_key, normal_key = jax.random.split(key)
    uniforms, normals = jax.random.uniform(uniform_key, (count,)), jax.random.normal(normal_key, (count, 6))
    return jax.vmap(pose_mixture.sample, in_axes=(0, 0, None))(uniforms, normals, mixture)


@jax.jit
def built(log_weights: jax.Array, means: jax.Array, covariances: jax.Array, line: SpinLines) -> PoseMixture:
    """The mixture of an object's modes."""
    log_own, centres, own = (leaf[None] for leaf in own_components(log_weights, means, covariances, line))
    return PoseMixture.build(log_own, centres, own, line.points_m[None]).of(jnp.array(0))


def of_one_mode(mean: np.ndarray, covariance: jax.Array, line: SpinLines) -> PoseMixture:
    """The components of an object all of whose weight is in its first mode."""
    log_weights = jnp.where(jnp.arange(MODES) == 0, 0.0, -jnp.inf)
    means = jnp.broadcast_to(jnp.asarray(mean), (MODES, 7))
    covariances = jnp.broadcast_to(covariance, (MODES, 6, 6))
    return built(log_weights, means, covariances, line)


def differences(taught: PoseMixture, expected: PoseMixture, states: jax.Array) -> np.ndarray:
    """How much the log densities of two mixtures differ at states (S, 7)."""
    of_taught, of_expected = (
        jax.jit(jax.vmap(pose_mixture.log_density, in_axes=(None, 0)))(mixture, states)
        for mixture in (taught, expected)
    )
    return np.abs(of_taught - of_expected)


def test_a_round_objects_mixture_looks_the_same_from_all_sides(key: jax.Array, seed: int) -> None:
    """Its density changes little with the spin, though offset and tilt are correlated."""
    own = of_one_mode(MEAN, covariance(seed), ROUND)
    poses = samples(key, own, 200)

    def turned(pose: jax.Array, angle: jax.Array) -> jax.Array:
        rotation = jaxlie.SO3(pose[:4]) @ spin(ROUND.directions, angle)
        return jnp.concatenate([rotation.wxyz, place_of(ROUND.points_m, pose) - rotation @ ROUND.points_m])

    angles = jnp.linspace(0, 2 * jnp.pi, 37)
    log_densities = jax.jit(
        jax.vmap(
            lambda pose: jax.vmap(lambda angle: pose_mixture.log_density(own, turned(pose, angle)))(angles)
        )
    )(poses)

    ranges = np.ptp(np.asarray(log_densities), axis=1)
    assert np.median(ranges) < 0.6
    assert np.abs(log_densities[:, 6] - log_densities[:, 0]).max() < 1e-6  # a sixth of the circle


@pytest.mark.parametrize(
    ("line", "nats"), [(NOT_ROUND, 0.15), (ROUND, 0.5)]
)  # a component's tilt does not turn in it
def test_the_burn_in_teaches_mean_and_covariance(
    key: jax.Array, seed: int, line: SpinLines, nats: float
) -> None:
    """States drawn from the components give them back, for round objects from all around the circle."""
    expected = of_one_mode(MEAN, covariance(seed), line)
    is_narrow = jnp.arange(2 * MODES) < MODES
    narrow = replace(expected, log_weights=jnp.where(is_narrow, expected.log_weights, -jnp.inf))
    states = samples(key, narrow, 4000)
    first = of_one_mode(MEAN + np.array([0, 0, 0, 0, 0.003, 0.003, 0]), 1e-5 * jnp.eye(6), line)

    taught = adapt_mixture(*jax.tree.map(lambda leaf: leaf[None], (first, line)), states[:, None]).of(
        jnp.asarray(0)
    )

    assert np.median(differences(taught, expected, states[:400])) < nats


def test_the_burn_in_teaches_every_mode(key: jax.Array, seed: int) -> None:
    """Of two modes that look alike in the world, one was visited: the other gets its covariance, too."""
    half_turn = jnp.concatenate(
        [
            (jaxlie.SO3(jnp.asarray(MEAN[:4])) @ spin(jnp.array([1.0, 0, 0]), jnp.asarray(jnp.pi))).wxyz,
            MEAN[4:],
        ]
    )
    mirrored = jnp.diag(jnp.array([1.0, 1, 1, 1, -1, -1]))
    one = covariance(seed)
    used = jnp.where(jnp.arange(MODES) < 2, 0.0, -jnp.inf)
    means = jnp.concatenate([jnp.asarray(MEAN)[None], jnp.broadcast_to(half_turn, (MODES - 1, 7))])
    covariances = jnp.concatenate([one[None], jnp.broadcast_to(mirrored @ one @ mirrored, (MODES - 1, 6, 6))])

    def mixture(log_weights: jax.Array, covariances: jax.Array) -> PoseMixture:
        log_weights = jax.nn.log_softmax(log_weights)
        return built(log_weights, means, covariances, NOT_ROUND)

    first = mixture(used, jnp.broadcast_to(1e-5 * jnp.eye(6), (MODES, 6, 6)))
    expected = mixture(used + jnp.log(jnp.where(jnp.arange(MODES) == 0, 0.95, 0.05)), covariances)
    is_first = (jnp.arange(2 * MODES) == 0) | (jnp.arange(2 * MODES) == 1)
    both = replace(expected, log_weights=jnp.where(is_first, jnp.log(0.5), -jnp.inf))
    states = samples(key, both, 8000)
    seen = states[jnp.abs(states[:, :4] @ MEAN[:4]) > 0.7]

    taught = adapt_mixture(*jax.tree.map(lambda leaf: leaf[None], (first, NOT_ROUND)), seen[:, None])

    assert np.median(differences(taught.of(jnp.asarray(0)), expected, states[:400])) < 0.15


def test_a_mixture_about_a_point_is_a_density(key: jax.Array, seed: int) -> None:
    """Offsets of a point that is not the middle: what is drawn there has the density that is told of it.

    The mean of p / q over draws of q is 1, p being another mixture whose offsets are the middle's own; five
    standard errors, a false alarm in a million.
    """
    middle = of_one_mode(MEAN, 0.2 * covariance(seed), NOT_ROUND)
    about = of_one_mode(MEAN, 2.0 * covariance(seed), replace(ROUND, free=jnp.array(False)))
    draws = samples(key, about, 20_000)
    densities = [
        jax.jit(jax.vmap(pose_mixture.log_density, in_axes=(None, 0)))(mixture, draws)
        for mixture in (middle, about)
    ]
    ratio = np.exp(np.asarray(densities[0] - densities[1]))
    assert abs(ratio.mean() - 1) < 5 * ratio.std() / np.sqrt(len(ratio))
