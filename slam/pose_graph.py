"""The keyframe pose graph: its optimum, and draws from the Gaussian that it implies.

Minimised over the poses, the first of them fixed (Grisetti et al. 2010, "A tutorial on graph-based SLAM"):

    1/2 sum_e r_e^T H_e r_e,    r_e = coordinates of (first_e^-1 second_e) in the chart at the measured pose,

with every edge scaled down where it contradicts the others (dynamic covariance scaling, Agarwal et al. 2013).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from slam import pose_gaussian
from slam.alignment import STIFFNESS
from slam.rigid import matrices_of, poses_of

ITERATIONS = 8
CONVERGED = 1e-6
"""Largest coordinate of a last step, metres or radians."""
TRUSTED_SQUARED_DISTANCE = 12.6
"""95% point of chi-square with six degrees of freedom: edges beyond it are scaled down."""
EDGE_BUCKET = 64


@dataclass(frozen=True, kw_only=True)
class PoseGraph:
    """E measured relative poses between N keyframes.

    Attributes:
        first: (E,) index of a keyframe.
        second: (E,) index of another.
        measured: (E, 7) first_from_second.
        precision: (E, 6, 6) in the chart at `measured`.
    """

    first: NDArray[np.int_]
    second: NDArray[np.int_]
    measured: NDArray[np.float32]
    precision: NDArray[np.float64]

    def __len__(self) -> int:
        """Number of edges."""
        return len(self.first)


@dataclass(frozen=True, kw_only=True)
class GraphOptimum:
    """Where the graph's poses agree best.

    Attributes:
        poses: (N, 4, 4) reference_from_keyframe.
        draws: (K, N, 6) draws of the Gaussian there, in the charts at `poses`; zero for the first.
    """

    poses: NDArray[np.float64]
    draws: NDArray[np.float64]


def optimum(key: jax.Array, graph: PoseGraph, poses: NDArray[np.float64], draws: int) -> GraphOptimum:
    """Gauss-Newton from poses (N, 4, 4), and perturb-and-solve draws at the optimum.

    A draw solves the normal equations with the edges' residuals replaced by their noise, which is exact
    for a Gaussian (Papandreou and Yuille 2010).
    """
    for _ in range(ITERATIONS):
        residuals, jacobian = _linearised(graph, poses)
        weights = _trusted(residuals, graph.precision)
        information = _information(graph.precision * weights[:, None, None])
        step = _solved(jacobian, len(poses), information, -residuals.ravel())
        poses = matrices_of(_displaced(poses_of(poses), jnp.asarray(step.reshape(-1, 6), jnp.float32)))
        if np.abs(step).max() < CONVERGED:
            break
    residuals, jacobian = _linearised(graph, poses)
    precision = graph.precision * _trusted(residuals, graph.precision)[:, None, None]
    noise = np.asarray(jax.random.normal(key, (draws, len(graph) + len(poses), 6)), np.float64)
    scales = np.linalg.cholesky(np.linalg.inv(precision))
    errors = np.einsum("eij,kej->kei", scales, noise[:, : len(graph)]).reshape(draws, -1)
    held = noise[:, len(graph) :].reshape(draws, -1) * np.sqrt(STIFFNESS)
    drawn = _solved(jacobian, len(poses), _information(precision), errors.T, held.T)
    return GraphOptimum(poses=poses, draws=drawn.T.reshape(draws, len(poses), 6))


def _trusted(residuals: NDArray[np.float64], precision: NDArray[np.float64]) -> NDArray[np.float64]:
    """Factor (E,) of each edge's precision."""
    squared = np.einsum("ei,eij,ej->e", residuals, precision, residuals)
    scale = np.minimum(1.0, 2 * TRUSTED_SQUARED_DISTANCE / (TRUSTED_SQUARED_DISTANCE + squared))
    return scale**2


def _linearised(
    graph: PoseGraph, poses: NDArray[np.float64]
) -> tuple[NDArray[np.float64], scipy.sparse.csr_array]:
    """Residuals (E, 6) and their derivative (6 E, 6 N) in the charts at the poses."""
    count = len(graph)
    room = -(-count // EDGE_BUCKET) * EDGE_BUCKET
    order = np.resize(np.arange(count), room)
    relative = poses_of(np.linalg.inv(poses[graph.first[order]]) @ poses[graph.second[order]])
    leaves = _edge_derivatives(relative, jnp.asarray(graph.measured[order]))
    residuals, of_first, of_second = (np.asarray(leaf, np.float64)[:count] for leaf in leaves)
    rows = np.arange(count + 1)
    blocks = np.stack([of_first, of_second], axis=1).reshape(-1, 6, 6)
    columns = np.stack([graph.first, graph.second], axis=1).ravel()
    shape = (6 * count, 6 * len(poses))
    return residuals, scipy.sparse.bsr_array((blocks, columns, 2 * rows), shape=shape).tocsr()


@jax.jit
@jax.vmap
def _edge_derivatives(relative: jax.Array, measured: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Residual (6,) at relative (7,), and its derivatives (6, 6) in displacements of both keyframes."""
    pose = jaxlie.SE3(relative)
    identity = jaxlie.SE3.identity().wxyz_xyz.astype(relative.dtype)

    def residual(of_first: jax.Array, of_second: jax.Array) -> jax.Array:
        first = jaxlie.SE3(pose_gaussian.displaced(identity, of_first))
        second = jaxlie.SE3(pose_gaussian.displaced(pose.wxyz_xyz, of_second))
        return pose_gaussian.coordinates(measured, (first.inverse() @ second).wxyz_xyz)

    zero = jnp.zeros(6, relative.dtype)
    return residual(zero, zero), *jax.jacfwd(residual, argnums=(0, 1))(zero, zero)


@jax.jit
@jax.vmap
def _displaced(pose: jax.Array, step: jax.Array) -> jax.Array:
    return pose_gaussian.displaced(pose, step)


def _information(precision: NDArray[np.float64]) -> scipy.sparse.bsr_array:
    """Block diagonal (6 E, 6 E) of edge precisions (E, 6, 6)."""
    count = len(precision)
    return scipy.sparse.bsr_array(
        (precision, np.arange(count), np.arange(count + 1)), shape=(6 * count, 6 * count)
    )


def _solved(
    jacobian: scipy.sparse.csr_array,
    count: int,
    information: scipy.sparse.bsr_array,
    targets: NDArray[np.float64],
    held: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Displacements (6 N,) or (6 N, K) of N poses that meet the edges' targets best; none of the first."""
    free = scipy.sparse.eye_array(6 * count, 6 * count - 6, k=-6)
    of_free = scipy.sparse.csr_array(jacobian @ free)
    weighted = scipy.sparse.csr_array(of_free.T @ information)
    right = weighted @ targets
    if held is not None:
        right = right + free.T @ held
    normal = scipy.sparse.csc_array(weighted @ of_free + STIFFNESS * (free.T @ free))
    return free @ splu(normal).solve(right)
