"""State-space models whose filters are known exactly, behind the interface of `slam.filter.smc`."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from slam.filter import smc


@dataclass(frozen=True)
class Corridor:
    """A walker in a corridor of cells with reflecting ends, who sees a noisy brightness of each cell."""

    brightness: tuple[float, ...]
    stay: float = 0.4
    sigma: float = 0.5

    @property
    def transition(self) -> NDArray[np.float64]:
        """(S, S) probabilities, rows from."""
        cells = len(self.brightness)
        matrix = self.stay * np.eye(cells)
        for cell in range(cells):
            for neighbour in (cell - 1, cell + 1):
                matrix[cell, np.clip(neighbour, 0, cells - 1)] += 0.5 * (1 - self.stay)
        return matrix

    def log_likelihood(self, observations: NDArray[np.float64]) -> NDArray[np.float64]:
        """(T, S) log p(y_t | cell)."""
        deviation = (observations[:, None] - np.asarray(self.brightness)) / self.sigma
        return -0.5 * deviation**2 - np.log(self.sigma) - 0.5 * np.log(2 * np.pi)

    def exact(self, observations: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Log evidence and final filtering distribution by the forward recursion from cell 0."""
        alpha = np.eye(len(self.brightness))[0]
        for log_likelihood in self.log_likelihood(observations):
            alpha = (alpha @ self.transition) * np.exp(log_likelihood)
        return float(np.log(alpha.sum())), alpha / alpha.sum()

    def estimate(
        self, key: jax.Array, observations: NDArray[np.float64], count: int
    ) -> tuple[jax.Array, jax.Array]:
        """Log evidence and filtering distribution by K particles with a deliberately poor proposal."""
        log_transition = jnp.log(jnp.asarray(self.transition))
        log_proposal = jnp.log(0.7 * jnp.asarray(self.transition) + 0.3 / len(self.brightness))
        population = smc.uniform_population(jnp.zeros(count, jnp.int32))
        log_evidence = jnp.zeros(())
        for step_key, row in zip(
            jax.random.split(key, len(observations)), self.log_likelihood(observations), strict=True
        ):
            log_likelihood = jnp.asarray(row)

            def propose(
                key: jax.Array, cells: jax.Array, row: jax.Array = log_likelihood
            ) -> tuple[jax.Array, jax.Array]:
                moved = jax.random.categorical(key, log_proposal[cells])
                return moved, row[moved] + log_transition[cells, moved] - log_proposal[cells, moved]

            population, info = smc.step(step_key, population, propose, 0.5)
            log_evidence += info.log_evidence
        one_hot = jax.nn.one_hot(population.particles, len(self.brightness))
        return log_evidence, jnp.exp(population.log_weights) @ one_hot


@dataclass(frozen=True)
class UnknownCorridor:
    """The same walk through cells of unknown binary colour, each seen with probability `error` of a slip."""

    cells: int
    stay: float = 0.4
    error: float = 0.15

    @property
    def transition(self) -> NDArray[np.float64]:
        """(S, S) probabilities, rows from."""
        return Corridor((0.0,) * self.cells, self.stay).transition

    def exact(self, observations: NDArray[np.int_]) -> tuple[float, NDArray[np.float64]]:
        """Log evidence and p(x_T) by all S^T trajectories, the map summed out of each."""
        total = np.zeros(self.cells)
        for path in itertools.product(range(self.cells), repeat=len(observations)):
            steps = np.prod([self.transition[a, b] for a, b in itertools.pairwise((0, *path))])
            total[path[-1]] += steps * self._marginal_likelihood(path, observations)
        return float(np.log(total.sum())), total / total.sum()

    def _marginal_likelihood(self, path: tuple[int, ...], observations: NDArray[np.int_]) -> float:
        likelihood = 1.0
        for cell in set(path):
            seen = [int(y) for x, y in zip(path, observations, strict=True) if x == cell]
            given = [np.prod([1 - self.error if y == c else self.error for y in seen]) for c in (0, 1)]
            likelihood *= 0.5 * sum(given)
        return float(likelihood)

    def estimate(
        self, key: jax.Array, observations: NDArray[np.int_], count: int
    ) -> tuple[jax.Array, jax.Array]:
        """Log evidence and p(x_T) by K particles that own their maps: log odds of every cell."""
        log_transition = jnp.log(jnp.asarray(self.transition))
        slip = jnp.log((1 - self.error) / self.error)
        population = smc.uniform_population((jnp.zeros(count, jnp.int32), jnp.zeros((count, self.cells))))
        log_evidence = jnp.zeros(())
        for step_key, colour in zip(jax.random.split(key, len(observations)), observations, strict=True):
            sign = 2.0 * float(colour) - 1.0

            def propose(
                key: jax.Array, particles: tuple[jax.Array, jax.Array], sign: float = sign
            ) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
                cells, log_odds = particles
                moved = jax.random.categorical(key, log_transition[cells])
                rows = jnp.arange(count)
                agrees = jax.nn.sigmoid(sign * log_odds[rows, moved])
                predictive = agrees * (1 - self.error) + (1 - agrees) * self.error
                return (moved, log_odds.at[rows, moved].add(sign * slip)), jnp.log(predictive)

            population, info = smc.step(step_key, population, propose, 0.5)
            log_evidence += info.log_evidence
        one_hot = jax.nn.one_hot(population.particles[0], self.cells)
        return log_evidence, jnp.exp(population.log_weights) @ one_hot


@dataclass(frozen=True)
class RandomWalk:
    """x_t = a x_t-1 + N(0, q), y_t = x_t + N(0, r), x_0 = 0: Kalman's own."""

    decay: float = 0.9
    step_variance: float = 0.5
    noise_variance: float = 0.3

    def exact(self, observations: NDArray[np.float64]) -> tuple[float, float, float]:
        """Log evidence, mean and variance of x_T by the Kalman filter."""
        mean, variance, log_evidence = 0.0, 0.0, 0.0
        for observation in observations:
            mean, variance = self.decay * mean, self.decay**2 * variance + self.step_variance
            spread = variance + self.noise_variance
            log_evidence += -0.5 * ((observation - mean) ** 2 / spread + np.log(2 * np.pi * spread))
            gain = variance / spread
            mean, variance = mean + gain * (observation - mean), (1 - gain) * variance
        return float(log_evidence), float(mean), float(variance)

    def estimate(
        self, key: jax.Array, observations: jax.Array, count: int
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Log evidence, particles (K,) and log weights (K,) of x_T with a shifted, widened proposal."""
        population = smc.uniform_population(jnp.zeros(count))
        log_evidence = jnp.zeros(())
        step_sigma, noise_sigma = self.step_variance**0.5, self.noise_variance**0.5
        for index, step_key in enumerate(jax.random.split(key, len(observations))):
            observation = observations[index]

            def propose(
                key: jax.Array, x: jax.Array, y: jax.Array = observation
            ) -> tuple[jax.Array, jax.Array]:
                centre, width = 0.5 * (self.decay * x + y), 1.2 * step_sigma
                moved = centre + width * jax.random.normal(key, x.shape)
                log_ratio = (
                    jax.scipy.stats.norm.logpdf(moved, self.decay * x, step_sigma)
                    + jax.scipy.stats.norm.logpdf(y, moved, noise_sigma)
                    - jax.scipy.stats.norm.logpdf(moved, centre, width)
                )
                return moved, log_ratio

            population, info = smc.step(step_key, population, propose, 0.5)
            log_evidence += info.log_evidence
        return log_evidence, population.particles, population.log_weights
