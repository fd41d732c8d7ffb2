"""Scores of masks: sums of a grid's evidence over their cells, in chosen places or the best of all.

The best are found by branch and bound, as Hess et al. (2016) match scans. In a block of cells a mask scores
at most what the greatest evidence in reach of its surface cells gives, and the least in reach of its outer
ones. Only blocks whose bounds are high are scored cell by cell: a few in a thousand.

A grid is laid out flat, with room behind each row for masks to reach over, so that a mask's cell is one
number to add to a place. Sums are exact integers. For bounds a kernel sums shifted pieces of the grid that
stay in the fastest memory; for scores it gathers.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from scene.execution import map_parallel, score_on_all_cores
from scene.masks.grid import STEPS, EvidenceGrid
from scene.masks.shape_masks import MOST_CELLS, SURFACE, ShapeMasks

EDGE = 2
"""Cells along each edge of a block: its bound takes an eighth of the time of its scores."""

LOWER = 0.8
"""Ratio of successive thresholds: blocks are scored whose bounds exceed the first, then the next. Speed."""

LEAST_SCORE = 1 / (STEPS * SURFACE * MOST_CELLS)
"""Any score above 0 is as high."""

BATCH = 2048
"""Orientations that are scored together, each in its cells."""

PIECE = 1024
"""Blocks whose bounds are computed together."""

UNROLLED = 8
"""Shifts added in one pass over a piece."""

FEWEST_PLACES = 2**16
"""Of a flat layout, which grows by powers of two: most images share few kernels."""

_CORNERS = np.array(list(itertools.product(range(EDGE), repeat=3)))
"""Cells of a block, from its first."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FlatGrid:
    """A grid laid out flat, or several of one size.

    Attributes:
        evidence: (..., L) int8, zero round the grid and in the room between its rows.
        first: place of cell (0, 0, 0).
        strides: (3,) places from a cell to the next one along each axis.
        size: (3,) cells along each axis.
    """

    evidence: NDArray[np.int8]
    first: int
    strides: NDArray[np.int64]
    size: NDArray[np.int64]

    @classmethod
    def of(cls, evidence: NDArray[np.int8], reach: int) -> FlatGrid:
        """The layout of evidence (..., X, Y, Z) for masks that reach so many cells from their centre."""
        size = np.array(evidence.shape[-3:])
        padded = size + np.array([0, reach, reach])
        strides = np.array([padded[1] * padded[2], padded[2], 1])
        first = int(reach * strides.sum())
        needed = 2 * first + int(padded.prod()) + PIECE
        several = evidence.shape[:-3]
        flat = np.zeros((*several, max(FEWEST_PLACES, 1 << (needed - 1).bit_length())), np.int8)
        rows = flat[..., first : first + padded.prod()].reshape(*several, *padded)
        rows[..., : size[1], : size[2]] = evidence
        return cls(evidence=flat, first=first, strides=strides, size=size)

    def cells(self, places: NDArray[np.integer]) -> NDArray[np.int64]:
        """Cells (..., 3) of places counted from the first; those between rows lie beside the grid."""
        cells = np.stack([places // stride for stride in self.strides], axis=-1).astype(np.int64)
        cells[..., 1:] %= self.strides[:2] // self.strides[1:]
        return cells


@dataclass(frozen=True, kw_only=True, eq=False)
class MaskScores:
    """Masks put down in places.

    Attributes:
        turns: (n,) their orientations.
        cells: (n, 3) where their centres are.
        scores: (n,) at most 1.
    """

    turns: NDArray[np.integer]
    cells: NDArray[np.integer]
    scores: NDArray[np.float32]

    @classmethod
    def none(cls) -> MaskScores:
        """Of no place."""
        return cls(turns=np.zeros(0, int), cells=np.zeros((0, 3), int), scores=np.zeros(0, np.float32))

    def has(self, count: int, score: float) -> bool:
        """Whether so many of them, the highest first, reach a score."""
        return len(self.scores) >= count and self.scores[count - 1] >= score

    def best(self, count: int) -> MaskScores:
        """Those of highest score, the highest first."""
        order = np.argsort(-self.scores, kind="stable")[:count]
        return MaskScores(turns=self.turns[order], cells=self.cells[order], scores=self.scores[order])

    def with_others(self, others: MaskScores) -> MaskScores:
        """These, and others behind them."""
        return MaskScores(
            turns=np.concatenate([self.turns, others.turns]),
            cells=np.concatenate([self.cells, others.cells]),
            scores=np.concatenate([self.scores, others.scores]),
        )


def best_places(grid: EvidenceGrid, masks: ShapeMasks, count: int) -> MaskScores:
    """The pairs of orientation and cell that score most in a whole grid, one in a block at most.

    Args:
        grid: the evidence.
        masks: k orientations.
        count: of pairs.

    Returns:
        Those of a score above 0, the highest first; fewer than `count` where few blocks have one.
    """
    flat, blocks = FlatGrid.of(grid.evidence, masks.reach), _Blocks.of(grid.evidence, masks)
    found, least = MaskScores.none(), blocks.score_limit
    while least >= LEAST_SCORE and not found.has(count, least):
        above, least = least, least * LOWER
        found = found.with_others(_best_in_blocks(flat, masks, *blocks.between(least, above))).best(count)
    return found.best(int((found.scores > 0).sum()))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Blocks:
    """Upper bounds of the scores in blocks.

    Attributes:
        totals: (k, P) int16, sums of evidence that are as high as any in a block.
        places: (P,) in the flat layout of blocks.
        flat: that layout; the first cell is the block before the grid's first.
        full: (k,) the sum where all surface cells have evidence 1.
    """

    totals: NDArray[np.int16]
    places: NDArray[np.int64]
    flat: FlatGrid
    full: NDArray[np.float32]

    @classmethod
    def of(cls, evidence: NDArray[np.int8], masks: ShapeMasks) -> _Blocks:
        """Those in which masks can meet a surface at all.

        Evidence is laid out once for each corner of a block, the greatest of blocks that begin at such a
        corner for a mask's surface cells and the least for its outer ones.
        """
        extremes, reach = _extremes(evidence), -(-masks.reach // EDGE)
        flat = FlatGrid.of(extremes, reach)
        steps, corner = np.divmod(masks.offsets.astype(np.int64), EDGE)
        layout = np.ravel_multi_index(tuple(np.moveaxis(corner, -1, 0)), 3 * (EDGE,))
        layout += np.where(masks.weights < 0, len(_CORNERS), 0)
        shifts = steps @ flat.strides + layout * flat.evidence.shape[-1]
        shared = jax.device_put(
            (
                flat.evidence.ravel(),
                shifts.astype(np.int32),
                masks.weights.astype(np.int16),
                -(-masks.counts // UNROLLED),
            )
        )
        met = maximum_filter(extremes[0] > 0, 2 * reach + 3, mode="constant")
        pieces = np.unique(np.argwhere(met) @ flat.strides // PIECE)
        totals = np.zeros((len(masks.weights), len(pieces), PIECE), np.int16)

        def add(number: int) -> None:
            totals[:, number] = _totals(flat.first + PIECE * pieces[number], *shared)

        map_parallel(add, range(len(pieces)))
        return cls(
            totals=totals.reshape(len(totals), -1),
            places=(PIECE * pieces[:, None] + np.arange(PIECE)).ravel(),
            flat=flat,
            full=STEPS * masks.most,
        )

    @property
    def score_limit(self) -> float:
        """A score that no bound reaches; 0 where no bound is above 0."""
        greatest = self.totals.max(axis=1, initial=0)
        return float(np.where(greatest > 0, (greatest + 1) / self.full, 0).max(initial=0))

    def between(self, low: float, high: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Orientations (n,) and blocks (n, 3) of bounds over one score and not over another."""
        least, most = (np.floor(score * self.full).astype(np.int16)[:, None] for score in (low, high))
        turns, place = np.divmod(
            np.flatnonzero((self.totals > least) & (self.totals <= most)), self.totals.shape[1]
        )
        cells = self.flat.cells(self.places[place])
        within = ((cells > 0) & (cells < self.flat.size)).all(axis=-1)
        return turns[within], cells[within] - 1


def _extremes(evidence: NDArray[np.int8]) -> NDArray[np.int8]:
    """The greatest evidence in blocks, and the least, (16, X, Y, Z) by the corner at which these begin.

    The first block along an axis begins EDGE cells before the grid, or one less.
    """
    padded = np.pad(evidence, [(EDGE, -size % EDGE) for size in evidence.shape])
    filters = maximum_filter, minimum_filter
    both = [extreme(padded, EDGE, mode="constant", origin=-(EDGE // 2)) for extreme in filters]
    steps = [tuple(slice(first, None, EDGE) for first in corner) for corner in _CORNERS.tolist()]
    return np.stack([one[step] for one in both for step in steps]).astype(np.int8)


@jax.jit
def _totals(
    start: int, evidence: jax.Array, shifts: jax.Array, weights: jax.Array, passes: jax.Array
) -> jax.Array:
    """Sums (k, PIECE) of evidence over masks in a piece's places."""

    def one(mask: tuple[jax.Array, ...]) -> jax.Array:
        shift, weight, passes = mask

        def add(step: jax.Array, total: jax.Array) -> jax.Array:
            for number in range(UNROLLED):
                place = step * UNROLLED + number
                moved = jax.lax.dynamic_slice(evidence, (start + shift[place],), (PIECE,))
                total = total + weight[place] * moved.astype(jnp.int16)
            return total

        return jax.lax.fori_loop(0, passes, add, jnp.zeros(PIECE, jnp.int16))

    return jax.lax.map(one, (shifts, weights, passes))


def _best_in_blocks(
    flat: FlatGrid, masks: ShapeMasks, turns: NDArray[np.integer], blocks: NDArray[np.integer]
) -> MaskScores:
    """The best cells of n orientations (n,), each in a block of (n, 3)."""
    if not len(turns):
        return MaskScores.none()
    cells = EDGE * blocks[:, None] + _CORNERS
    scores = scores_in(flat, masks, turns, cells)
    rows, best = np.arange(len(turns)), scores.argmax(axis=1)
    return MaskScores(turns=turns, cells=cells[rows, best], scores=scores[rows, best])


def scores_in(
    flat: FlatGrid, masks: ShapeMasks, turns: NDArray[np.integer], cells: NDArray[np.integer]
) -> NDArray[np.float32]:
    """Scores (n, c) of n orientations, one or more, each in cells (n, c, 3); -inf in cells beside the grid.

    Args:
        flat: the grid.
        masks: of the shape.
        turns: (n,) orientations.
        cells: (n, c, 3).
    """
    inside = ((cells >= 0) & (cells < flat.size)).all(axis=-1)
    places = flat.first + np.where(inside, cells @ flat.strides, 0)
    shifts = (masks.offsets @ flat.strides).astype(np.int32)
    gather = partial(_gathered, *jax.device_put((flat.evidence, shifts, masks.weights)))
    totals = score_on_all_cores(gather, (turns.astype(np.int32), places.astype(np.int32)), BATCH)
    return np.where(inside, totals / (STEPS * masks.most[turns, None]), -np.inf).astype(np.float32)


@jax.jit
def _gathered(
    evidence: jax.Array, shifts: jax.Array, weights: jax.Array, pairs: tuple[jax.Array, jax.Array]
) -> jax.Array:
    """Sums (n, c) of evidence over masks (k, m), of which pairs name (n,), put down in places (n, c)."""

    def one(pair: tuple[jax.Array, jax.Array]) -> jax.Array:
        turn, place = pair
        met = evidence.at[place[:, None] + shifts[turn][None]].get(mode="promise_in_bounds")
        weighted = met.astype(jnp.int16) * weights[turn][None].astype(jnp.int16)
        return jnp.sum(weighted, axis=1, dtype=jnp.int32).astype(jnp.float32)

    return jax.lax.map(one, pairs, batch_size=64)
