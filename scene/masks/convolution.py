"""Scores of masks: sums of a grid's evidence over their cells, in every place or in chosen ones.

The grid is laid out flat, with room behind each row for masks to reach over, so that a mask's cell is one
number to add to a place. Sums are exact integers. Where the whole grid is scored, a kernel sums shifted
pieces of it that stay in the fastest memory; in chosen places it gathers.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from scene.execution import map_parallel
from scene.masks.grid import STEPS, EvidenceGrid
from scene.masks.shape_masks import ShapeMasks

PIECE, RUN = 1024, 16
"""Places scored together, and neighbours of which the best is kept."""

UNROLLED = 8
"""Shifts added in one pass over a piece."""

FEWEST_PLACES = 2**20
"""Of the flat layout, which grows by powers of two: nearly all images share one kernel."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FlatGrid:
    """A grid laid out flat.

    Attributes:
        evidence: (L,) int8, zero round the grid and in the room between its rows.
        inside: (L,) bool, the grid's own places.
        first: place of cell (0, 0, 0).
        strides: (3,) places from a cell to the next one along each axis.
        size: (3,) cells along each axis.
    """

    evidence: NDArray[np.int8]
    inside: NDArray[np.bool_]
    first: int
    strides: NDArray[np.int64]
    size: NDArray[np.int64]

    @classmethod
    def of(cls, grid: EvidenceGrid, reach: int) -> FlatGrid:
        """The layout for masks that reach so many cells from their centre."""
        size = np.array(grid.evidence.shape)
        padded = size + np.array([0, reach, reach])
        strides = np.array([padded[1] * padded[2], padded[2], 1])
        first = int(reach * strides.sum())
        needed = 2 * first + int(padded.prod()) + PIECE
        evidence = np.zeros(max(FEWEST_PLACES, 1 << (needed - 1).bit_length()), np.int8)
        inside = np.zeros(len(evidence), bool)
        for places, values in ((evidence, grid.evidence), (inside, True)):
            rows = places[first : first + padded.prod()].reshape(padded)
            rows[:, : size[1], : size[2]] = values
        return cls(evidence=evidence, inside=inside, first=first, strides=strides, size=size)

    def pieces(self, reach: int) -> NDArray[np.int64]:
        """Where pieces start, counted from the first place, in which masks can meet a surface at all."""
        inner = self.evidence[self.first : self.first + self.length].reshape(
            self.size[0], -1, self.strides[1]
        )
        met = maximum_filter(inner > 0, 2 * reach + 1, mode="constant").reshape(-1)
        met = np.append(met, np.zeros(-len(met) % PIECE, bool))
        return PIECE * np.flatnonzero(met.reshape(-1, PIECE).any(axis=1))

    @property
    def length(self) -> int:
        """Places from the first cell to the end of the last row."""
        return int(self.size[0] * self.strides[0])

    def cells(self, places: NDArray[np.integer]) -> NDArray[np.int64]:
        """Cells (..., 3) of places counted from the first."""
        steps = np.stack([places // stride for stride in self.strides], axis=-1).astype(np.int64)
        steps[..., 1:] %= self.strides[:2] // self.strides[1:]
        return steps


def best_places(
    flat: FlatGrid, masks: ShapeMasks, count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """The pairs of orientation and cell that score most over a whole grid, one of RUN neighbours at most.

    Args:
        flat: the grid.
        masks: k orientations.
        count: of pairs.

    Returns:
        Orientations (n,), cells (n, 3) and scores (n,), at most 1, the highest first; fewer than `count`
        where the grid is small.
    """
    shared = jax.device_put(
        (
            flat.evidence,
            flat.inside,
            (masks.offsets @ flat.strides).astype(np.int32),
            masks.weights.astype(np.int16),
            1 / (STEPS * masks.most),
            -(-masks.counts // UNROLLED),
        )
    )

    def score(start: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        return jax.device_get(_best_of_runs(flat.first + start, *shared))

    starts = flat.pieces(masks.reach)
    if not len(starts):
        return np.zeros(0, np.int64), np.zeros((0, 3), np.int64), np.zeros(0, np.float32)
    scores, winners = (np.stack(part, axis=1) for part in zip(*map_parallel(score, starts), strict=True))
    best = np.argpartition(-scores, min(count, scores.size) - 1, axis=None)[:count]
    best = best[np.argsort(-scores.ravel()[best], kind="stable")]
    best = best[np.isfinite(scores.ravel()[best])]
    turns, piece, run = np.unravel_index(best, scores.shape)
    cells = flat.cells(starts[piece] + run * RUN + winners.ravel()[best])
    return turns, cells, scores.ravel()[best]


@jax.jit
def _best_of_runs(
    start: int,
    evidence: jax.Array,
    inside: jax.Array,
    shifts: jax.Array,
    weights: jax.Array,
    scale: jax.Array,
    passes: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Best scores (k, PIECE / RUN) of a piece's runs, -inf outside, and which of a run's places has it."""
    within = jax.lax.dynamic_slice(inside, (start,), (PIECE,))

    def one(mask: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        shift, weight, scale, passes = mask

        def add(step: jax.Array, total: jax.Array) -> jax.Array:
            for number in range(UNROLLED):
                place = step * UNROLLED + number
                moved = jax.lax.dynamic_slice(evidence, (start + shift[place],), (PIECE,))
                total = total + weight[place] * moved.astype(jnp.int16)
            return total

        total = jax.lax.fori_loop(0, passes, add, jnp.zeros(PIECE, jnp.int16))
        score = jnp.where(within, total.astype(jnp.float32) * scale, -jnp.inf).reshape(-1, RUN)
        return jnp.max(score, axis=1), jnp.argmax(score, axis=1)

    return jax.lax.map(one, (shifts, weights, scale, passes))


def scores_in(
    flat: FlatGrid, masks: ShapeMasks, turns: NDArray[np.integer], cells: NDArray[np.integer]
) -> NDArray[np.float32]:
    """Scores (n, c) of n orientations, each in cells (n, c, 3); cells beside the grid count as within reach.

    Args:
        flat: the grid.
        masks: of the shape.
        turns: (n,) orientations.
        cells: (n, c, 3).
    """
    inside = ((cells >= 0) & (cells < flat.size)).all(axis=-1)
    places = flat.first + np.where(inside, cells @ flat.strides, 0)
    shifts = (masks.offsets @ flat.strides).astype(np.int32)[turns]
    totals = _gathered(flat.evidence, places.astype(np.int32), shifts, masks.weights[turns])
    scores = np.asarray(totals) / (STEPS * masks.most[turns, None])
    return np.where(inside, scores, -np.inf).astype(np.float32)


@jax.jit
def _gathered(evidence: jax.Array, places: jax.Array, shifts: jax.Array, weights: jax.Array) -> jax.Array:
    """Sums (n, c) of evidence over masks (n, m) put down in places (n, c)."""

    def one(mask: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        place, shift, weight = mask
        met = evidence.at[place[:, None] + shift[None]].get(mode="promise_in_bounds")
        return jnp.sum(met.astype(jnp.int16) * weight[None].astype(jnp.int16), axis=1, dtype=jnp.int32)

    return jax.lax.map(one, (places, shifts, weights), batch_size=64)
