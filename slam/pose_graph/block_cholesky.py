"""Cholesky factorisation of symmetric positive definite matrices of 6 x 6 blocks, most of which are zero.

Multifrontal (Duff and Reid 1983): a keyframe is eliminated in the small dense matrix of those that it is tied
to by then, and what it leaves there is added to the next one's. The order is that of minimum degree. The
blocks of the inverse on the factor's pattern follow the other way round (Takahashi, Fagan and Chen 1973), so
that the covariances of all keyframes cost about as much as one factorisation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

SIDE = 6
"""Of a block."""


@dataclass(frozen=True)
class _Column:
    """One block column of the factor L.

    Attributes:
        later: (s,) block columns eliminated later in which it has blocks.
        inverse: (6, 6) of its diagonal block, lower triangular.
        below: (6 s, 6).
    """

    later: NDArray[np.int_]
    inverse: NDArray[np.float64]
    below: NDArray[np.float64]


@dataclass(frozen=True)
class BlockCholesky:
    """P A P^T = L L^T.

    Attributes:
        order: (n,) block of A that each column of L eliminates.
        columns: n.
    """

    order: NDArray[np.int_]
    columns: list[_Column]

    @classmethod
    def of(
        cls, diagonal: NDArray[np.float64], pairs: NDArray[np.int_], blocks: NDArray[np.float64]
    ) -> BlockCholesky:
        """A matrix with blocks (n, 6, 6) on its diagonal, and (e, 6, 6) at (row, column) pairs (e, 2) off it.

        Each pair stands for its transpose, too; several of one place are added up.
        """
        count = len(diagonal)
        order = _minimum_degree(count, pairs)
        place = np.empty(count, int)
        place[order] = np.arange(count)
        rows, columns = place[pairs].reshape(-1, 2).T
        lower = np.where((rows > columns)[:, None, None], blocks, blocks.swapaxes(1, 2))
        keys, which = np.unique(
            np.minimum(rows, columns) * count + np.maximum(rows, columns), return_inverse=True
        )
        summed = np.zeros((len(keys), SIDE, SIDE))
        np.add.at(summed, which, lower)
        of_column, rows = np.divmod(keys, count)
        starts = np.searchsorted(of_column, np.arange(count + 1))
        return cls(order, _factorised(diagonal[order], rows, starts, summed))

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """A^-1 of columns (6 n, m) or of one (6 n,)."""
        values = right.reshape(len(self.order), SIDE, -1)[self.order]
        for index, column in enumerate(self.columns):
            values[index] = column.inverse @ values[index]
            if len(column.later):
                values[column.later] -= (column.below @ values[index]).reshape(-1, SIDE, values.shape[2])
        return self._back_substituted(values).reshape(right.shape)

    def transposed_solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """(P^T L)^-T of columns (6 n, m): of independent unit Gaussians draws of precision A."""
        return self._back_substituted(right.reshape(len(self.order), SIDE, -1).copy()).reshape(right.shape)

    def _back_substituted(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """L^-T of values (n, 6, m) in the order of the columns, in place; in the order of A."""
        for index in range(len(self.columns) - 1, -1, -1):
            column = self.columns[index]
            later = values[column.later].reshape(len(column.below), values.shape[2])
            values[index] = column.inverse.T @ (values[index] - column.below.T @ later)
        found = np.empty_like(values)
        found[self.order] = values
        return found

    def diagonal_of_inverse(self) -> NDArray[np.float64]:
        """Diagonal blocks (n, 6, 6) of A^-1."""
        found = np.empty((len(self.order), SIDE, SIDE))
        fronts: dict[int, NDArray[np.float64]] = {}
        waiting = np.zeros(len(self.order), int)
        for column in self.columns:
            if len(column.later):
                waiting[column.later[0]] += 1
        for index in range(len(self.columns) - 1, -1, -1):
            column = self.columns[index]
            own = column.inverse.T @ column.inverse
            front = own
            if len(column.later):
                parent = int(column.later[0])
                place = _scalar_rows(
                    np.searchsorted(np.append(parent, self.columns[parent].later), column.later)
                )
                known = fronts[parent][np.ix_(place, place)]
                gain = column.below @ column.inverse
                across = -known @ gain
                own = own - gain.T @ across
                front = np.block([[own, across.T], [across, known]])
                waiting[parent] -= 1
                if not waiting[parent]:
                    del fronts[parent]
            found[self.order[index]] = own
            if waiting[index]:
                fronts[index] = front
        return found


def _minimum_degree(count: int, pairs: NDArray[np.int_]) -> NDArray[np.int_]:
    """An order of elimination that fills little."""
    ends = np.concatenate([pairs, pairs[:, ::-1]]).T
    pattern = scipy.sparse.coo_array((np.full(ends.shape[1], -1.0), tuple(ends)), shape=(count, count))
    dominant = pattern.tocsc() + (2.0 * len(pairs) + 1.0) * scipy.sparse.eye_array(count, format="csc")
    factor = splu(
        scipy.sparse.csc_array(dominant), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
    )
    return np.argsort(factor.perm_c)


def _factorised(
    diagonal: NDArray[np.float64],
    rows: NDArray[np.int_],
    starts: NDArray[np.int_],
    blocks: NDArray[np.float64],
) -> list[_Column]:
    """Columns of the factor; the matrix has blocks at rows[starts[j] : starts[j + 1]] of its column j."""
    count = len(diagonal)
    patterns = [set(rows[starts[j] : starts[j + 1]].tolist()) for j in range(count)]
    left: list[list[tuple[NDArray[np.int_], NDArray[np.float64]]]] = [[] for _ in range(count)]
    columns: list[_Column] = []
    for index in range(count):
        later = np.asarray(sorted(patterns[index]), int)
        nodes = np.append(index, later)
        front = np.zeros((SIDE * len(nodes), SIDE * len(nodes)))
        front[:SIDE, :SIDE] = diagonal[index]
        own = slice(starts[index], starts[index + 1])
        front[_scalar_rows(np.searchsorted(nodes, rows[own])), :SIDE] += blocks[own].reshape(-1, SIDE)
        for of_child, update in left[index]:
            place = _scalar_rows(np.searchsorted(nodes, of_child))
            front[np.ix_(place, place)] += update
        left[index] = []
        inverse = np.linalg.inv(_cholesky(front[:SIDE, :SIDE])).astype(np.float64)
        below = front[SIDE:, :SIDE] @ inverse.T
        columns.append(_Column(later, inverse, below))
        if len(later):
            left[later[0]].append((later, front[SIDE:, SIDE:] - below @ below.T))
            patterns[later[0]].update(later[1:].tolist())
        patterns[index] = set()
    return columns


def _cholesky(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The lower factor of the lower triangle of a matrix, no numbers where it has none."""
    try:
        return np.linalg.cholesky(matrix).astype(np.float64)
    except np.linalg.LinAlgError:
        return np.full_like(matrix, np.nan)


def _scalar_rows(blocks: NDArray[np.int_]) -> NDArray[np.int_]:
    return (SIDE * blocks[:, None] + np.arange(SIDE)).ravel()
