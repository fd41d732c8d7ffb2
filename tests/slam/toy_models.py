"""State-space models whose filters are known exactly, behind the interface of `slam.filter.smc`."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import jax
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
        self, key: jax.Array, observations: NDArray[np.float64], most: int, least: float = 0.0
    ) -> tuple[float, NDArray[np.float64]]:
        """Log evidence and filtering distribution by histories that branch into all cells that are near."""
        population = smc.certain(0)
        log_evidence = 0.0
        for step_key, row in zip(
            jax.random.split(key, len(observations)), self.log_likelihood(observations), strict=True
        ):

            def branch(_: int, cell: int, row: NDArray[np.float64] = row) -> Sequence[tuple[int, float]]:
                near = np.flatnonzero(self.transition[cell]).tolist()
                return [(other, float(np.log(self.transition[cell, other]) + row[other])) for other in near]

            population, info = smc.step(step_key, population, branch, most, least)
            log_evidence += info.log_evidence
        log_evidence += float(np.logaddexp.reduce(population.log_weights))
        return log_evidence, population.probabilities @ np.eye(len(self.brightness))[
            list(population.histories)
        ]


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
        self, key: jax.Array, observations: NDArray[np.int_], most: int
    ) -> tuple[float, NDArray[np.float64]]:
        """Log evidence and p(x_T) by histories that own their maps: log odds of every cell."""
        slip = np.log((1 - self.error) / self.error)
        population: smc.Population[tuple[int, tuple[float, ...]]] = smc.certain((0, (0.0,) * self.cells))
        log_evidence = 0.0
        for step_key, colour in zip(jax.random.split(key, len(observations)), observations, strict=True):
            sign = 2.0 * float(colour) - 1.0

            def branch(
                _: int, history: tuple[int, tuple[float, ...]], sign: float = sign
            ) -> Sequence[tuple[tuple[int, tuple[float, ...]], float]]:
                cell, log_odds = history
                children = []
                for moved in np.flatnonzero(self.transition[cell]).tolist():
                    agrees = 1.0 / (1.0 + np.exp(-sign * log_odds[moved]))
                    predictive = agrees * (1 - self.error) + (1 - agrees) * self.error
                    told = tuple(odds + sign * slip * (index == moved) for index, odds in enumerate(log_odds))
                    log_p = float(np.log(self.transition[cell, moved] * predictive))
                    children.append(((moved, told), log_p))
                return children

            population, info = smc.step(step_key, population, branch, most, 0.0)
            log_evidence += info.log_evidence
        log_evidence += float(np.logaddexp.reduce(population.log_weights))
        cells = [cell for cell, _ in population.histories]
        return log_evidence, population.probabilities @ np.eye(self.cells)[cells]


def _log_normal(value: float, mean: float, variance: float) -> float:
    return float(-0.5 * ((value - mean) ** 2 / variance + np.log(2 * np.pi * variance)))


@dataclass(frozen=True)
class Gaussian:
    """One history of a walk on a line: what is known of where it has led."""

    mean: float
    variance: float


@dataclass(frozen=True)
class AmbiguousWalk:
    """x_t = a x_t-1 + N(0, q); y_t = x_t + one of some offsets + N(0, r), x_0 = 0.

    With one offset it is Kalman's own; with several a corridor in which places look alike.
    """

    offsets: tuple[float, ...] = (0.0,)
    decay: float = 0.9
    step_variance: float = 0.5
    noise_variance: float = 0.3

    def by_quadrature(
        self, observations: NDArray[np.float64], grid: NDArray[np.float64]
    ) -> tuple[float, NDArray[np.float64]]:
        """Log evidence and p(x_T) at the places of a grid (G,)."""
        spacing = float(grid[1] - grid[0])
        step = np.exp(_log_normals(grid[:, None], self.decay * grid[None], self.step_variance))
        density = np.exp(_log_normals(grid, np.zeros(1), self.step_variance))
        log_evidence = 0.0
        for index, observation in enumerate(observations):
            density = step @ density * spacing if index else density
            offsets = np.asarray(self.offsets)[:, None]
            density = density * np.exp(
                _log_normals(observation - offsets, grid[None], self.noise_variance)
            ).mean(axis=0)
            log_evidence += np.log(density.sum() * spacing)
            density = density / (density.sum() * spacing)
        return float(log_evidence), density

    def estimate(
        self, key: jax.Array, observations: NDArray[np.float64], most: int
    ) -> tuple[float, smc.Population[Gaussian]]:
        """Log evidence and histories of x_T, each the offsets of all observations."""
        population = smc.certain(Gaussian(0.0, 0.0))
        log_evidence = 0.0
        for step_key, observation in zip(
            jax.random.split(key, len(observations)), observations.tolist(), strict=True
        ):

            def branch(_: int, past: Gaussian, y: float = observation) -> Sequence[tuple[Gaussian, float]]:
                mean, variance = (
                    self.decay * past.mean,
                    self.decay**2 * past.variance + self.step_variance,
                )
                spread = variance + self.noise_variance
                gain = variance / spread
                return [
                    (
                        Gaussian(mean + gain * (y - offset - mean), (1 - gain) * variance),
                        _log_normal(y - offset, mean, spread) - float(np.log(len(self.offsets))),
                    )
                    for offset in self.offsets
                ]

            population, info = smc.step(step_key, population, branch, most, 0.0)
            log_evidence += info.log_evidence
        return log_evidence + float(np.logaddexp.reduce(population.log_weights)), population


def _log_normals(
    values: NDArray[np.float64], means: NDArray[np.float64], variance: float
) -> NDArray[np.float64]:
    return -0.5 * ((values - means) ** 2 / variance + np.log(2 * np.pi * variance))
