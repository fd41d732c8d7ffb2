"""Convergence of the chains: split R-hat and effective sample size (Vehtari et al. 2021)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.result import SceneResult
from shapes.geometry.poses import matrices_of


@dataclass(frozen=True, kw_only=True)
class Convergence:
    """Over log posterior, coordinates of the middles of objects' bounding boxes, and indicators of edges.

    An object's origin may lie at its edge: then it is elsewhere in each of two poses that look the same.

    Attributes:
        r_hat: largest split R-hat; 1 where chains agree, NaN with too few samples.
        effective_samples: smallest effective number of samples among them.
    """

    r_hat: float
    effective_samples: float


def convergence(scene: SceneResult, middles_m: NDArray[np.float64]) -> Convergence:
    """Of the samples of a parsed scene.

    Args:
        scene: as parsed.
        middles_m: (N, 3) of the bounding boxes, in the objects' frames.
    """
    chains = int(scene.chain.max(initial=0)) + 1
    found = scene.found
    in_camera = np.einsum("snij,nj->sni", matrices_of(scene.sample_poses), np.insert(middles_m, 3, 1, axis=1))
    edges = (
        scene.sample_parents[:, found, None] == np.arange(-1, scene.edge_probabilities.shape[1])[None, None]
    )
    traces = np.concatenate(
        [
            scene.sample_log_posteriors[:, None],
            in_camera[:, found, :3].reshape(len(edges), -1),
            edges.reshape(len(edges), -1),
        ],
        axis=1,
    )
    traces = traces.reshape(-1, chains, traces.shape[1])
    if len(traces) < 4:
        return Convergence(r_hat=float("nan"), effective_samples=float("nan"))
    varied = [trace for trace in np.moveaxis(traces, 2, 0) if np.ptp(trace) > 0]
    return Convergence(
        r_hat=max((split_r_hat(trace) for trace in varied), default=1.0),
        effective_samples=min(
            (effective_samples(trace) for trace in varied), default=float(traces[..., 0].size)
        ),
    )


def split_r_hat(trace: NDArray[np.float64]) -> float:
    """Split R-hat of draws (n, chains); infinite where every half stands still at its own place."""
    within, total = _variances(_halves(trace))
    return float(np.sqrt(total / within)) if within > 0 else float("inf")


def effective_samples(trace: NDArray[np.float64]) -> float:
    """Effective number of independent draws among (n, chains), by Geyer's initial positive sequence."""
    halves = _halves(trace)
    count, chains = halves.shape
    within, total = _variances(halves)
    if total <= 0:
        return float(halves.size)
    centred = halves - halves.mean(axis=0)
    size = 2 * count
    spectrum = np.abs(np.fft.rfft(centred, size, axis=0)) ** 2
    autocovariance = np.fft.irfft(spectrum, size, axis=0)[:count].mean(axis=1) / count
    correlation = 1 - (within - autocovariance) / total
    pairs = correlation[: count // 2 * 2].reshape(-1, 2).sum(axis=1)
    pairs = pairs[: int(np.argmax(pairs <= 0)) if (pairs <= 0).any() else len(pairs)]
    time = max(2 * np.minimum.accumulate(pairs).sum() - 1, 1 / np.log10(max(halves.size, 10)))
    return float(count * chains / time)


def _halves(trace: NDArray[np.float64]) -> NDArray[np.float64]:
    """The first and the second half of every chain as chains of their own (n // 2, 2 * chains)."""
    half = len(trace) // 2
    return np.concatenate([trace[:half], trace[len(trace) - half :]], axis=1).astype(np.float64)


def _variances(trace: NDArray[np.float64]) -> tuple[float, float]:
    """Mean variance within chains, and the estimate of the whole variance."""
    within = float(trace.var(axis=0, ddof=1).mean())
    return within, float((len(trace) - 1) / len(trace) * within + trace.mean(axis=0).var(ddof=1))
