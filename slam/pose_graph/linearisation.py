"""The overlaps of keyframes, linearised at their poses, and how much to believe them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import numpy as np
from numpy.typing import NDArray

from slam.likelihood.distortion import NODES, Distortion
from slam.likelihood.overlap_density import FieldTerms, overlap_terms
from slam.likelihood.score_variance import LEAST_CURVATURE
from slam.pose_graph.overlaps import IMAGE_BUCKET, Keyframes, relative_to
from slam.pose_graph.sparse_gaussian import FieldTerm, PoseGraph

LEAST_INLIERS = 60.0
"""Ten times the six coordinates of a pose."""

THINNED = 8
"""Of the samples, every so many decide on the first rounds: they stand for all."""


@dataclass(frozen=True)
class Linearised:
    """The graph of E overlaps, its pairs being (image, surface), and what tells how much to believe it.

    Attributes:
        graph: not tempered, but for what it says of the field.
        curvature: (E, 6, 6) in the image's displacement, by Gauss-Newton.
        score_variance: (E, 6, 6) of the gradients in it.
        inliers: (E,).
        meeting: (E,) pixels that meet the surface.
    """

    graph: PoseGraph
    curvature: NDArray[np.float64]
    score_variance: NDArray[np.float64]
    inliers: NDArray[np.float64]
    meeting: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Field:
    """The distortion field where terms are taken, and the exponents (N,) that they are then given.

    There are too many to be kept one by one until their own exponents are known.
    """

    distortion: Distortion
    exponents: NDArray[np.float64]


class _FieldSums:
    """What tempered terms say of the field's nodes, added up."""

    def __init__(self, keyframes: int) -> None:
        self.precision, self.gradient = np.zeros((NODES, NODES)), np.zeros(NODES)
        self.cross = np.zeros((keyframes, 6, NODES))

    def add(
        self,
        terms: FieldTerms,
        pairs: NDArray[np.int_],
        exponents: NDArray[np.float64],
        projection: NDArray[np.float64],
    ) -> None:
        """Terms of pairs (B, 2), tempered by exponents (B,), displacements projected (B, 12, 12)."""
        self.precision += np.einsum("e,eij->ij", exponents, np.asarray(terms.precision)[: len(pairs)])
        self.gradient += exponents @ np.asarray(terms.gradient, np.float64)[: len(pairs)]
        cross = exponents[:, None, None] * (projection @ np.asarray(terms.cross)[: len(pairs)])
        np.add.at(self.cross, pairs, cross.reshape(len(pairs), 2, 6, -1))

    def term(self, distortion: Distortion) -> FieldTerm:
        """With the prior, in the field's coordinates."""
        factor = distortion.factor
        return FieldTerm(
            precision=np.eye(factor.shape[1]) + factor.T @ self.precision @ factor,
            gradient=distortion.coordinates + factor.T @ self.gradient,
            cross=self.cross.reshape(-1, NODES) @ factor,
        )


def linearised_at(
    keyframes: Keyframes,
    poses: NDArray[np.float32],
    inflation: float,
    astray: NDArray[np.bool_],
    field: Field | None = None,
    stride: int = 1,
    *,
    told: bool = False,
) -> Linearised | None:
    """Overlaps that agree at all; keyframes that are `astray` (N,) have no part in it. None without any.

    Where they are to be `told` terms are projected on what gaps tell of displacements (`told_projections`).
    """
    stride = stride if inflation == 1.0 else THINNED
    disparity = None if field is None else field.distortion.disparity_per_m.astype(np.float32)
    sums = None if field is None else _FieldSums(len(poses))
    overlaps, parts = [], []
    for surface, samples, index, images in keyframes.batches(stride):
        relative = relative_to(poses[index], poses[np.resize(images, IMAGE_BUCKET)])
        terms = overlap_terms(surface, samples, relative, keyframes.noise, inflation, disparity)
        pairs, count = np.stack([images, np.full(len(images), index)], axis=1), len(images)
        precision, gradient, score_variance, information, inliers, meeting = (
            np.asarray(leaf, np.float64)[:count] for leaf in jax.tree.leaves(replace(terms, field=None))
        )
        projection = np.tile(np.eye(12), (count, 1, 1))
        if told:
            precision[:, :6, :6] = _positive_part(precision[:, :6, :6])
            projection = told_projections(precision, information)
        agree = (stride * inliers > LEAST_INLIERS) & ~astray[pairs].any(axis=1)
        if field is not None and sums is not None and terms.field is not None:
            exponents = np.where(agree, field.exponents[images], 0.0)
            sums.add(terms.field, pairs, exponents, projection)
        projected = projection @ precision @ projection.swapaxes(1, 2)
        moved = (projection @ gradient[..., None])[..., 0]
        kept = projected, moved, precision[:, :6, :6], score_variance, inliers, meeting
        parts.append([leaf[agree] for leaf in kept])
        overlaps.append(pairs[agree])
    if not sum(map(len, overlaps)):
        return None
    precision, gradient, *others = map(np.concatenate, zip(*parts, strict=True))
    graph = PoseGraph(
        keyframes=len(poses),
        pairs=np.concatenate(overlaps),
        precision=precision,
        gradient=gradient,
        field=None if field is None or sums is None else sums.term(field.distortion),
        fixed=keyframes.fixed,
    )
    return Linearised(graph, *others)


def told_projections(precision: NDArray[np.float64], information: NDArray[np.float64]) -> NDArray[np.float64]:
    """How scores (B, 12) of overlaps are to be weighed, so that they tell no more than they know (B, 12, 12).

    Noise of normals adds to the curvature H of Gauss-Newton, as errors of regressors do (Fuller 1987,
    "Measurement error models", section 1.1): along a bare wall it is all there is. With the information H_u
    that is free of it, sum w n m^T over the normals n, m of both keyframes, the score's Godambe information
    is H_u H^-1 H_u, that of the score H_u H^-1 s. Both ends of an overlap are displaced by one relative
    pose, so that all of it is in the image's displacement.
    """
    curvature = precision[:, :6, :6]
    inverse = np.linalg.inv(curvature + _floor(curvature))
    both_ends = precision[:, :, :6] @ inverse
    projected = both_ends @ information @ inverse
    return np.concatenate([projected, np.zeros_like(projected)], axis=2)


def _positive_part(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of symmetric matrices (B, 6, 6): single precision leaves some below zero, which projections enlarge."""
    values, vectors = np.linalg.eigh(matrices)
    return (vectors * np.maximum(values, 0.0)[:, None]) @ vectors.swapaxes(1, 2)


def _floor(of_image: NDArray[np.float64]) -> NDArray[np.float64]:
    """What is added to curvatures (E, 6, 6) before they are inverted."""
    return LEAST_CURVATURE * (1.0 + np.trace(of_image, axis1=1, axis2=2))[:, None, None] * np.eye(6)


def exponents_of(linearised: Linearised) -> NDArray[np.float64]:
    """Exponent (N,) of each image's densities: its pixels count once, and as many as are independent.

    An image's inliers over those of its largest overlap tell by how many surfaces a pixel is explained; the
    spread of the blocks' scores, how much of the curvature is repetition
    (`slam.likelihood.noise_calibration`).
    """
    graph, images = linearised.graph, linearised.graph.pairs[:, 0]
    total, largest = np.zeros(graph.keyframes), np.ones(graph.keyframes)
    np.add.at(total, images, linearised.inliers)
    np.maximum.at(largest, images, linearised.inliers)
    curvature = linearised.curvature
    repetition = np.linalg.solve(curvature + _floor(curvature), linearised.score_variance)
    inflation = max(1.0, float(np.median(np.trace(repetition, axis1=1, axis2=2) / 6)))
    return 1.0 / (np.maximum(1.0, total / largest) * inflation)
