"""One step of sequential Monte Carlo for any model: weights, effective sample size, resampling, evidence.

The same code runs in exact toy models and behind the camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from shapes.resampling import resample_systematically

Propose = Callable[[jax.Array, Any], tuple[Any, jax.Array]]
"""(key, particles) -> (extended particles, log p(y|x) + log p(x|past) - log q(x) per particle (K,))."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Population:
    """Weighted particles.

    Attributes:
        particles: a pytree whose leaves have the particle axis first.
        log_weights: (K,) normalised.
    """

    particles: Any
    log_weights: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StepInfo:
    """What one step did.

    Attributes:
        log_evidence: log p(y_t | y_1..t-1), estimated; its running sum is log of an unbiased estimate.
        ess: effective sample size after weighting.
        resampled: whether particles were drawn anew before this step's proposal.
        ancestors: (K,) index in the previous population of each particle.
    """

    log_evidence: jax.Array
    ess: jax.Array
    resampled: jax.Array
    ancestors: jax.Array


def uniform_population(particles: Any) -> Population:
    """Particles with equal weights."""
    count = len(jax.tree.leaves(particles)[0])
    return Population(particles, jnp.full(count, -jnp.log(count), dtype=jnp.float32))


def resample_if_degenerate(
    key: jax.Array, population: Population, ess_threshold: float
) -> tuple[Population, jax.Array, jax.Array]:
    """The population, drawn anew with equal weights where its ESS is under `ess_threshold` times K.

    Returns:
        The population, the ancestors (K,) and whether it was drawn anew.
    """
    log_weights = population.log_weights
    count = len(log_weights)
    poor = effective_sample_size(log_weights) < ess_threshold * count
    identity = jnp.arange(count, dtype=jnp.int32)
    ancestors = jnp.where(poor, resample_systematically(key, log_weights), identity)
    uniform = jnp.full_like(log_weights, -jnp.log(float(count)))
    particles = jax.tree.map(lambda leaf: leaf[ancestors], population.particles)
    return Population(particles, jnp.where(poor, uniform, log_weights)), ancestors, poor


def step(
    key: jax.Array, population: Population, propose: Propose, ess_threshold: float
) -> tuple[Population, StepInfo]:
    """Resample where the ESS is low, extend every particle, weigh it, add up the evidence."""
    resample_key, propose_key = jax.random.split(key)
    population, ancestors, poor = resample_if_degenerate(resample_key, population, ess_threshold)
    particles, log_increments = propose(propose_key, population.particles)
    log_weights, log_evidence = normalise(population.log_weights + log_increments)
    info = StepInfo(log_evidence, effective_sample_size(log_weights), poor, ancestors)
    return Population(particles, log_weights), info


def normalise(log_weights: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Normalised log weights (K,) and the log of their sum; all -inf becomes uniform with sum -inf."""
    log_sum = jax.nn.logsumexp(log_weights)
    uniform = jnp.full_like(log_weights, -jnp.log(float(len(log_weights))))
    return jnp.where(jnp.isfinite(log_sum), log_weights - log_sum, uniform), log_sum


def effective_sample_size(log_weights: jax.Array) -> jax.Array:
    """1 / sum w^2 of normalised log weights (K,), between 1 and K."""
    return jnp.exp(-jax.nn.logsumexp(2.0 * log_weights))
