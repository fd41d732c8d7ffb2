"""Scores of masks against a triple loop, at borders and half outside the grid."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from scene.masks.convolution import BATCH, EDGE, FlatGrid, best_places, scores_in
from scene.masks.grid import FREE, STEPS, EvidenceGrid
from scene.masks.shape_masks import MOST_CELLS, OUTSIDE, SURFACE, ShapeMasks

TURNS, REACH = 5, 5
SIZE = (8, 11, 7)


def random_masks(rng: np.random.Generator) -> ShapeMasks:
    """Cells up to REACH from the centre, more than half of the grid, of unequal number."""
    offsets = np.zeros((TURNS, MOST_CELLS, 3), np.int8)
    weights = np.zeros((TURNS, MOST_CELLS), np.int8)
    for turn in range(TURNS):
        count = int(rng.integers(20, MOST_CELLS + 1))
        offsets[turn, :count] = rng.integers(-REACH, REACH + 1, (count, 3))
        weights[turn, :count] = rng.choice([SURFACE, OUTSIDE], count)
    rotations = np.tile(np.eye(3, dtype=np.float32), (TURNS, 1, 1))
    return ShapeMasks(rotations=rotations, offsets=offsets, weights=weights)


def looped(grid: EvidenceGrid, masks: ShapeMasks) -> np.ndarray:
    """Scores (TURNS, X, Y, Z), cell by cell; nothing is known outside the grid."""
    scores = np.zeros((TURNS, *SIZE))
    for turn, *cell in itertools.product(range(TURNS), *map(range, SIZE)):
        for offset, weight in zip(masks.offsets[turn].tolist(), masks.weights[turn].tolist(), strict=True):
            met = [place + step for place, step in zip(cell, offset, strict=True)]
            if weight and all(0 <= place < size for place, size in zip(met, SIZE, strict=True)):
                scores[turn, *cell] += weight * int(grid.evidence[*met])
    surface = np.maximum(masks.weights.astype(int), 0).sum(axis=1)
    return scores / (STEPS * surface)[:, None, None, None]


@pytest.fixture
def problem(seed: int) -> tuple[EvidenceGrid, ShapeMasks]:
    """A grid of random evidence, and masks of which much lies outside it in most places."""
    rng = np.random.default_rng(seed)
    evidence = rng.choice(np.array([STEPS, -FREE, 0], np.int8), SIZE)
    return EvidenceGrid(evidence=evidence, pitch_m=0.01, camera_from_grid=np.eye(4)), random_masks(rng)


def test_gathers_agree_with_a_triple_loop(problem: tuple[EvidenceGrid, ShapeMasks]) -> None:
    """In every cell, borders included; cells beside the grid score nothing."""
    grid, masks = problem
    cells = np.stack(np.meshgrid(*map(np.arange, SIZE), indexing="ij"), axis=-1).reshape(-1, 3)
    cells = np.concatenate([cells, [[-1, 0, 0], [0, SIZE[1], 0], [0, 0, SIZE[2]]]])
    flat = FlatGrid.of(grid.evidence, masks.reach)

    scores = scores_in(flat, masks, np.arange(TURNS), np.tile(cells, (TURNS, 1, 1)))

    np.testing.assert_allclose(scores[:, :-3], looped(grid, masks).reshape(TURNS, -1), rtol=0, atol=1e-6)
    assert np.isneginf(scores[:, -3:]).all()


def looked_up(grid: EvidenceGrid, masks: ShapeMasks) -> np.ndarray:
    """Scores (k, X, Y, Z) in every cell, gathered."""
    size, count = grid.evidence.shape, len(masks.weights)
    cells = np.stack(np.meshgrid(*map(np.arange, size), indexing="ij"), axis=-1).reshape(-1, 1, 3)
    turns = np.repeat(np.arange(count), len(cells))
    flat = FlatGrid.of(grid.evidence, masks.reach)
    return scores_in(flat, masks, turns, np.tile(cells, (count, 1, 1))).reshape(count, *size)


def best_in_blocks(scores: np.ndarray) -> np.ndarray:
    """The best positive scores of orientations (TURNS, X, Y, Z) in blocks, the highest first."""
    padded = np.pad(scores, [(0, 0), *((0, -size % EDGE) for size in scores.shape[1:])], constant_values=-1)
    x, y, z = (size // EDGE for size in padded.shape[1:])
    best = padded.reshape(-1, x, EDGE, y, EDGE, z, EDGE).max(axis=(2, 4, 6)).ravel()
    return -np.sort(-best[best > 0])


def test_the_best_of_blocks_are_those_of_a_triple_loop(problem: tuple[EvidenceGrid, ShapeMasks]) -> None:
    """All blocks with a positive score are found, blocks that reach beyond the grid included."""
    grid, masks = problem
    scores = looped(grid, masks)

    found = best_places(grid, masks, 10**6)

    np.testing.assert_allclose(found.scores, scores[found.turns, *found.cells.T], rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.scores, best_in_blocks(scores), rtol=0, atol=1e-6)


@pytest.mark.parametrize("count", [1, 7, 40])
def test_the_best_few_are_those_of_all(problem: tuple[EvidenceGrid, ShapeMasks], count: int) -> None:
    """Bounds leave out no block that has one of them."""
    grid, masks = problem

    found = best_places(grid, masks, count)

    expected = best_in_blocks(looped(grid, masks))[:count]
    np.testing.assert_allclose(found.scores, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("surface", range(9, 25))
def test_the_highest_bound_is_scored(surface: int) -> None:
    """However it is rounded: masks of so many cells, apart, over a single one with evidence."""
    offsets, weights = np.zeros((1, MOST_CELLS, 3), np.int8), np.zeros((1, MOST_CELLS), np.int8)
    offsets[0, :surface] = 3 * np.stack(np.unravel_index(np.arange(surface), (4, 4, 4)), axis=1)
    weights[0, :surface] = SURFACE
    masks = ShapeMasks(rotations=np.eye(3, dtype=np.float32)[None], offsets=offsets, weights=weights)
    evidence = np.zeros((4, 4, 4), np.int8)
    evidence[3, 3, 3] = 1

    found = best_places(EvidenceGrid(evidence=evidence, pitch_m=0.01, camera_from_grid=np.eye(4)), masks, 1)

    np.testing.assert_allclose(found.scores, [1 / (STEPS * surface)], rtol=1e-6)


def test_blocks_are_scored_in_several_batches(seed: int) -> None:
    """A grid of more blocks than one batch holds."""
    rng = np.random.default_rng(seed)
    evidence = rng.choice(np.array([STEPS, -FREE, 0], np.int8), (31, 17, 13), p=[0.8, 0.1, 0.1])
    grid = EvidenceGrid(evidence=evidence, pitch_m=0.01, camera_from_grid=np.eye(4))
    masks = random_masks(rng)

    found = best_places(grid, masks, 10**6)

    expected = best_in_blocks(looked_up(grid, masks))
    assert len(expected) > BATCH
    np.testing.assert_allclose(found.scores, expected, rtol=0, atol=1e-6)


def test_a_grid_without_a_surface_has_no_places(problem: tuple[EvidenceGrid, ShapeMasks]) -> None:
    """Nothing scores where everything is free."""
    grid, masks = problem
    free = np.full(SIZE, -FREE, np.int8)

    assert len(best_places(replace(grid, evidence=free), masks, 10).scores) == 0


def test_whole_cells_move_the_answer_by_as_many(problem: tuple[EvidenceGrid, ShapeMasks]) -> None:
    """Evidence that moves within an empty grid moves the best place, and its score stays."""
    _, masks = problem
    found = []
    for step in (np.array([0, 0, 0]), np.array([3, 2, 1])):
        evidence = np.zeros((40, 40, 40), np.int8)
        low = 16 + step
        evidence[tuple(slice(one, one + 6) for one in low)] = np.random.default_rng(0).choice(
            np.array([STEPS, -FREE, 0], np.int8), (6, 6, 6)
        )
        grid = EvidenceGrid(evidence=evidence, pitch_m=0.01, camera_from_grid=np.eye(4))
        best = best_places(grid, masks, 1)
        found.append((int(best.turns[0]), (best.cells[0] - step).tolist(), float(best.scores[0])))

    assert found[0] == found[1]
