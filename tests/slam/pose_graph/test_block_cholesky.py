"""Block Cholesky factors against dense linear algebra."""

import numpy as np
import pytest

from slam.pose_graph.block_cholesky import BlockCholesky

COUNT = 40


def _loopy(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Diagonal, pairs, blocks of them, and the whole matrix: a chain with loops, some pairs twice."""
    pairs = [(index, index - 1) for index in range(1, COUNT)]
    pairs += [tuple(rng.choice(COUNT, 2, replace=False)) for _ in range(12)]
    pairs += [pair[::-1] for pair in pairs[::5]]
    diagonal = np.tile(np.eye(6), (COUNT, 1, 1))
    blocks, whole = [], np.eye(6 * COUNT)
    for pair in pairs:
        jacobian = rng.normal(size=(5, 12))
        term = jacobian.T @ jacobian
        index = np.concatenate([6 * one + np.arange(6) for one in pair])
        whole[np.ix_(index, index)] += term
        diagonal[pair[0]] += term[:6, :6]
        diagonal[pair[1]] += term[6:, 6:]
        blocks.append(term[:6, 6:])
    return diagonal, np.asarray(pairs), np.stack(blocks), whole


def test_solutions_and_inverse_are_those_of_dense_algebra(seed):
    """Limit: rounding of double precision at a condition number of some thousand."""
    rng = np.random.default_rng(seed)
    diagonal, pairs, blocks, whole = _loopy(rng)
    right = rng.normal(size=(6 * COUNT, 3))

    factor = BlockCholesky.of(diagonal, pairs, blocks)

    inverse = np.linalg.inv(whole)
    np.testing.assert_allclose(factor.solve(right), inverse @ right, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(factor.solve(right[:, 0]), inverse @ right[:, 0], rtol=1e-8, atol=1e-10)
    blocks_of_inverse = inverse.reshape(COUNT, 6, COUNT, 6)[range(COUNT), :, range(COUNT)]
    np.testing.assert_allclose(factor.diagonal_of_inverse(), blocks_of_inverse, rtol=1e-8, atol=1e-10)


def test_a_root_of_the_inverse_is_one(seed):
    """R R^T of all its columns; the right hand side is left as it was."""
    diagonal, pairs, blocks, whole = _loopy(np.random.default_rng(seed))
    unit = np.eye(6 * COUNT)

    root = BlockCholesky.of(diagonal, pairs, blocks).transposed_solve(unit)

    np.testing.assert_allclose(root @ root.T, np.linalg.inv(whole), rtol=1e-8, atol=1e-10)
    np.testing.assert_array_equal(unit, np.eye(6 * COUNT))


@pytest.mark.parametrize("count", [1, 2])
def test_few_blocks(count, seed):
    """One that nothing is tied to, and two that are not."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(count, 6, 6)) + 4 * np.eye(6)
    diagonal = roots @ roots.swapaxes(1, 2)

    factor = BlockCholesky.of(diagonal, np.zeros((0, 2), int), np.zeros((0, 6, 6)))

    np.testing.assert_allclose(factor.diagonal_of_inverse(), np.linalg.inv(diagonal), rtol=1e-9, atol=1e-12)


def test_a_matrix_that_is_not_positive_leaves_the_numbers():
    """And raises nothing: whoever asks looks whether poses are finite."""
    factor = BlockCholesky.of(np.full((1, 6, 6), np.nan), np.zeros((0, 2), int), np.zeros((0, 6, 6)))

    assert np.isnan(factor.solve(np.ones(6))).all()
