"""phi* against gradient ascent, the oracle of docs/model.md, section I."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shapes.learning.distillation import _drawn, distil

PARTICLES, VOXELS = 5, 8


@pytest.fixture
def particles(seed: int) -> tuple[jax.Array, jax.Array]:
    """Probabilities (K, V) of a 2x2x2 grid under K particles, and their log weights."""
    rng = np.random.default_rng(seed)
    phi = jnp.asarray(rng.uniform(0.02, 0.98, (PARTICLES, VOXELS)))
    return phi, jnp.log(jnp.asarray(rng.dirichlet(np.ones(PARTICLES))))


def divergence(phi: jax.Array, particles: jax.Array, log_weights: jax.Array) -> jax.Array:
    """KL(p || q_phi) of the mixture of products over the 2^8 states."""
    states = jnp.asarray(np.indices((2,) * VOXELS).reshape(VOXELS, -1).T)
    log_p = jnp.log(particles) @ states.T + jnp.log1p(-particles) @ (1 - states).T
    log_p = jax.nn.logsumexp(log_p + log_weights[:, None], axis=0)
    log_q = states @ jnp.log(phi) + (1 - states) @ jnp.log1p(-phi)
    return (jnp.exp(log_p) * (log_p - log_q)).sum()


def test_gradient_ascent_reaches_the_same(particles: tuple[jax.Array, jax.Array]) -> None:
    """Of E[log q_phi] over the logits of phi, in float64."""
    with jax.enable_x64(True):
        phi, log_weights = (jnp.asarray(np.asarray(part, np.float64)) for part in particles)
        log_weights -= jax.nn.logsumexp(log_weights)
        slope = jax.grad(lambda logits: divergence(jax.nn.sigmoid(logits), phi, log_weights))
        logits = jax.lax.fori_loop(0, 500, lambda _, at: at - 3.0 * slope(at), jnp.zeros(VOXELS))
        np.testing.assert_allclose(jax.nn.sigmoid(logits), distil(phi, log_weights), atol=1e-6)


def test_nothing_random_is_nearer(particles: tuple[jax.Array, jax.Array], seed: int) -> None:
    """KL at phi* is not above KL at 1,000 random phi."""
    phi, log_weights = particles
    best = divergence(jnp.asarray(distil(phi, log_weights), jnp.float32), phi, log_weights)
    tried = jnp.asarray(np.random.default_rng(seed + 1).uniform(0.01, 0.99, (1000, VOXELS)), jnp.float32)
    others = jax.vmap(lambda one: divergence(one, phi, log_weights))(tried)
    assert float(best) <= float(others.min())


@pytest.mark.parametrize("count", [4, 2])
def test_trajectories_that_are_equal_count_together(count: int, key: jax.Array) -> None:
    """Two of four are one with the sum of their weights; a systematic sample has each share to 1 / count."""
    one, other, third = np.random.default_rng(0).normal(size=(3, 5, 4, 4))
    poses, weights = np.stack([one, other, one, third]), np.array([0.35, 0.1, 0.3, 0.25])

    drawn, shares = _drawn(key, poses, np.log(weights) - 700.0, count)

    expected = {one.tobytes(): 0.65, other.tobytes(): 0.1, third.tobytes(): 0.25}
    assert sum(shares) == pytest.approx(1.0)
    assert len({pose.tobytes() for pose in drawn}) == len(drawn)
    for pose, share in zip(drawn, shares, strict=True):
        assert share == pytest.approx(expected[pose.tobytes()], abs=1e-12 if count == 4 else 0.5)
