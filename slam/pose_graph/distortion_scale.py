"""How strongly a sensor distorts, learnt from one recording: the scale of its distortion field's prior.

With coordinates c ~ N(0, s^2 I) and a likelihood that is Gaussian in c once the poses are integrated out,
exp(b^T c - c^T L c / 2), the scale's marginal likelihood is known in closed form (MacKay 1992, "Bayesian
interpolation"):

    2 log p(data | s) = b^T (L + I / s^2)^-1 b - log |I + s^2 L| + const.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from slam.pose_graph.sparse_gaussian import FieldPosterior

SCALES = tuple(np.geomspace(0.005, 2.0, 40).tolist())
"""Equally likely a priori: from a sensor without any distortion (1e-5/m, a tenth of a millimetre at 3 m) to
twice that of the 7-Scenes kitchen."""


@dataclass(frozen=True, kw_only=True)
class ScaledField:
    """The moments of the scale and of the field's coordinates, the scale integrated out.

    Attributes:
        scale: root of its mean square.
        mean: (F,) of the coordinates.
        covariance: (F, F).
    """

    scale: float
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]


def scaled_field(
    posterior: FieldPosterior, coordinates: NDArray[np.float64], scales: Sequence[float]
) -> ScaledField:
    """Given the posterior under unit Gaussians, and its mode: coordinates (F,)."""
    information = np.linalg.inv(posterior.covariance)
    values, vectors = np.linalg.eigh(information - np.eye(len(information)))
    values, pull = np.maximum(values, 0.0), vectors.T @ (information @ coordinates)
    squared = np.asarray(scales)[:, None] ** 2
    variances = squared / (1.0 + squared * values)
    log_evidence = 0.5 * (pull**2 * variances - np.log1p(squared * values)).sum(axis=1)
    shares, means = softmax(log_evidence), pull * variances
    mean = (shares @ means).astype(np.float64)
    spread = np.diag(shares @ variances) + (means * shares[:, None]).T @ means - np.outer(mean, mean)
    return ScaledField(
        scale=float(np.sqrt(shares @ squared[:, 0])),
        mean=vectors @ mean,
        covariance=vectors @ spread @ vectors.T,
    )


def unseen_field(size: int, scales: Sequence[float]) -> ScaledField:
    """Of F coordinates where nothing tells of them."""
    scale = float(np.sqrt(np.mean(np.square(scales))))
    return ScaledField(scale=scale, mean=np.zeros(size), covariance=scale**2 * np.eye(size))
