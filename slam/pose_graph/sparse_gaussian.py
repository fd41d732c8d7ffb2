"""The keyframe pose graph: its Newton step, and draws and marginals of the Gaussian that it implies.

Quadratic terms over pairs of keyframes, in displacements xi of both (Grisetti et al. 2010, "A tutorial on
graph-based SLAM"), the first keyframes being fixed:

    sum_e 1/2 [xi_i; xi_j]^T H_e [xi_i; xi_j] + g_e^T [xi_i; xi_j],

and where there is one, a term over all keyframes at once: a prior of the way from each to the next. Where the
sensor's distortion field is unknown too, its coordinates c stand in all terms: the arrow-shaped system is
solved by the Schur complement of the poses, and c is integrated out of what is told of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import jax
import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from slam.pose_graph.block_cholesky import BlockCholesky
from slam.registration.alignment import STIFFNESS


@dataclass(frozen=True, kw_only=True)
class JointTerm:
    """A quadratic term over all N keyframes.

    Attributes:
        precision: (6 N, 6 N), positive semidefinite.
        gradient: (6 N,).
    """

    precision: NDArray[np.float64]
    gradient: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class FieldTerm:
    """A quadratic term over F coordinates that all terms share, their prior included.

    Attributes:
        precision: (F, F), positive definite.
        gradient: (F,).
        cross: (6 N, F) with the keyframes' displacements.
    """

    precision: NDArray[np.float64]
    gradient: NDArray[np.float64]
    cross: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class FieldPosterior:
    """The Gaussian of the shared coordinates with the poses integrated out, and how these follow.

    Attributes:
        covariance: (F, F).
        sensitivity: (N, 6, F) of the keyframes' displacements, zero for fixed ones.
    """

    covariance: NDArray[np.float64]
    sensitivity: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class PoseGraph:
    """E terms over pairs of N keyframes.

    Attributes:
        keyframes: N.
        pairs: (E, 2) indices i and j.
        precision: (E, 12, 12) H, positive semidefinite.
        gradient: (E, 12) g.
        joint: over all keyframes, or None.
        field: what the terms share, or None.
        fixed: so many keyframes, the first ones, are not displaced.
    """

    keyframes: int
    pairs: NDArray[np.int_]
    precision: NDArray[np.float64]
    gradient: NDArray[np.float64]
    joint: JointTerm | None = None
    field: FieldTerm | None = None
    fixed: int = 1

    @cached_property
    def factorised(self) -> BlockCholesky:
        """The precision of all keyframes that are not fixed, `STIFFNESS` added to its diagonal."""
        return _normal_equations(self, STIFFNESS)


def damped_step(graph: PoseGraph, damping: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Displacements (N, 6) that minimise the terms and half of `damping` times their own squares.

    Fixed keyframes stay. Damping, in 1/m^2 and 1/rad^2, keeps a step from leaving the neighbourhood that
    the terms were taken in, along directions which they hardly see. Also the step (F,) of what terms share.
    """
    gradient = _summed(graph, graph.gradient)
    if graph.joint is not None:
        gradient += graph.joint.gradient
    factor, held = _normal_equations(graph, damping), 6 * graph.fixed
    step = np.append(np.zeros(held), factor.solve(-gradient[held:])).reshape(-1, 6)
    if graph.field is None:
        return step, np.zeros(0)
    shared = _field_posterior(graph, graph.field, factor)
    slope = graph.field.gradient + graph.field.cross.T @ step.ravel()
    shared_step = -shared.covariance @ slope
    return step + shared.sensitivity @ shared_step, shared_step


def draws(key: jax.Array, graph: PoseGraph, count: int) -> NDArray[np.float64]:
    """Displacements (count, N, 6), Gaussian of the graph's precision around zero, given what terms share."""
    noise = np.asarray(jax.random.normal(key, (count, 6 * graph.keyframes)), np.float64)
    drawn, held = noise.T.copy(), 6 * graph.fixed
    drawn[:held] = 0.0
    if graph.keyframes > graph.fixed:
        drawn[held:] = graph.factorised.transposed_solve(drawn[held:])
    return drawn.T.reshape(count, -1, 6)


def field_posterior(graph: PoseGraph) -> FieldPosterior:
    """Of a graph whose terms share coordinates."""
    assert graph.field is not None
    return _field_posterior(graph, graph.field, graph.factorised)


def _field_posterior(graph: PoseGraph, field: FieldTerm, factor: BlockCholesky) -> FieldPosterior:
    """By the Schur complement of the poses, whose normal equations are factorised."""
    held = 6 * graph.fixed
    follow = np.concatenate([np.zeros((held, field.cross.shape[1])), -factor.solve(field.cross[held:])])
    precision = field.precision + field.cross.T @ follow
    return FieldPosterior(
        covariance=np.linalg.inv(0.5 * (precision + precision.T)).astype(np.float64),
        sensitivity=follow.reshape(graph.keyframes, 6, -1),
    )


def conditional_marginals(graph: PoseGraph) -> NDArray[np.float64]:
    """Covariances (N, 6, 6) of the displacements under the same Gaussian, zero for fixed keyframes.

    Given what terms share: its part is S C S^T with the sensitivity S of the `FieldPosterior`.
    """
    covariances = np.zeros((graph.keyframes, 6, 6))
    if graph.keyframes > graph.fixed:
        covariances[graph.fixed :] = graph.factorised.diagonal_of_inverse()
    return covariances


def connected_to_first(graph: PoseGraph) -> NDArray[np.bool_]:
    """Which keyframes (N,) the terms tie to the first, directly or through others; a joint one ties all."""
    if graph.joint is not None:
        return np.ones(graph.keyframes, bool)
    terms = np.ones(len(graph.pairs)), tuple(graph.pairs.T)
    adjacency = scipy.sparse.coo_array(terms, shape=(graph.keyframes, graph.keyframes))
    _, component = connected_components(adjacency, directed=False)
    return component == component[0]


def _summed(graph: PoseGraph, of_terms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum (6 N,) of vectors (E, 12) of the terms."""
    total = np.zeros((graph.keyframes, 6))
    np.add.at(total, graph.pairs, of_terms.reshape(-1, 2, 6))
    return total.ravel()


def _normal_equations(graph: PoseGraph, stiffness: float) -> BlockCholesky:
    """The factorised precision of all keyframes that are not fixed, `stiffness` added to its diagonal."""
    diagonal = np.tile(stiffness * np.eye(6), (graph.keyframes, 1, 1))
    np.add.at(diagonal, graph.pairs[:, 0], graph.precision[:, :6, :6])
    np.add.at(diagonal, graph.pairs[:, 1], graph.precision[:, 6:, 6:])
    pairs, blocks = graph.pairs, graph.precision[:, :6, 6:]
    if graph.joint is not None:
        jointly = graph.joint.precision.reshape(graph.keyframes, 6, graph.keyframes, 6).swapaxes(1, 2)
        every = np.stack(np.tril_indices(graph.keyframes, -1), axis=1)
        diagonal += jointly[np.arange(graph.keyframes), np.arange(graph.keyframes)]
        pairs = np.concatenate([pairs, every])
        blocks = np.concatenate([blocks, jointly[tuple(every.T)]])
    free = (pairs >= graph.fixed).all(axis=1)
    return BlockCholesky.of(diagonal[graph.fixed :], pairs[free] - graph.fixed, blocks[free])
