"""Whether chains agree: rank-normalised split R-hat, and effective samples of the bulk and of the tails.

Vehtari, Gelman, Simpson, Carpenter, Buerkner, "Rank-normalization, folding, and localization", 2021; the
figures themselves are arviz-stats'.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from arviz_stats.base.array import array_stats
from numpy.typing import NDArray

from scene.result import SceneResult

CONVERGED_R_HAT = 1.1
"""Chains with a larger R-hat are told as not converged (Gelman and Rubin's bound; Vehtari et al. ask for
1.01 of those who publish)."""

ENOUGH_SAMPLES = 400
"""Effective samples from which on spreads are steady to a tenth (Vehtari et al., section 4)."""

TAILS = 0.05, 0.95
"""Quantiles whose estimates are judged as tails (Vehtari et al.)."""
LEAST_DRAWS = 4
"""Of a chain, below which there is no half to compare with the other."""


@dataclass(frozen=True, kw_only=True)
class Convergence:
    """Of traces (one or more); the worst of them counts.

    Attributes:
        r_hat: largest R-hat; 1 where chains agree, NaN with too few samples.
        bulk_samples: smallest effective number of samples, of means and shares.
        tail_samples: the same of the 5% and 95% quantiles.
    """

    r_hat: float
    bulk_samples: float
    tail_samples: float

    @property
    def effective_samples(self) -> float:
        """Of the bulk or of the tails, whichever are fewer."""
        return min(self.bulk_samples, self.tail_samples)

    @property
    def converged(self) -> bool:
        """True if chains agree; False too where there are too few samples to say so."""
        return self.r_hat < CONVERGED_R_HAT


@dataclass(frozen=True, kw_only=True)
class SceneConvergence:
    """Of the samples of a parsed scene.

    Attributes:
        overall: of the log posterior, the centres of objects and which edges there are.
        centres: of each object's centre alone, the N objects one after another.
        modes: of which mode each object is in, where samples are in several.
    """

    overall: Convergence
    centres: tuple[Convergence, ...]
    modes: tuple[Convergence, ...]


def scene_convergence(scene: SceneResult, centres_m: NDArray[np.float64]) -> SceneConvergence:
    """Do the chains of a parsed scene agree?

    An object's origin may lie at its edge: then it is elsewhere in each of two poses that look the same.

    Args:
        scene: as parsed.
        centres_m: (N, 3) of the bounding boxes, in the objects' frames.
    """
    count, found = len(scene), np.flatnonzero(scene.found)
    points = [scene.sampled_points(one, centres_m[one]) for one in range(count)]
    edges = (
        scene.sample_parents[:, found, None] == np.arange(-1, scene.edge_probabilities.shape[1])[None, None]
    )
    shared = [scene.sample_log_posteriors[:, None], edges.reshape(len(edges), -1)]
    overall = np.concatenate([*shared, *(points[one] for one in found)], axis=1)
    modes = scene.sample_modes[:, :, None] == np.arange(scene.mode_probabilities.shape[1])
    return SceneConvergence(
        overall=convergence(_by_chain(overall, scene)),
        centres=tuple(convergence(_by_chain(points[one], scene)) for one in range(count)),
        modes=tuple(convergence(_by_chain(modes[:, one], scene)) for one in range(count)),
    )


def convergence(traces: NDArray[np.float64]) -> Convergence:
    """Of traces (Q, chains, draws); those that never change, or hold what is not a number, say nothing."""
    traces = traces[np.isfinite(traces).all(axis=(1, 2))]
    if traces.shape[2] < LEAST_DRAWS:
        return Convergence(r_hat=np.nan, bulk_samples=np.nan, tail_samples=np.nan)
    varied = traces[np.ptp(traces, axis=(1, 2)) > 0]
    if not len(varied):
        everything = float(np.prod(traces.shape[1:]))
        return Convergence(r_hat=1.0, bulk_samples=everything, tail_samples=everything)
    return Convergence(
        r_hat=max(map(_r_hat, varied)),
        bulk_samples=min(_samples(one, "bulk") for one in varied),
        tail_samples=min(_samples(one, "tail") for one in varied),
    )


def _r_hat(trace: NDArray[np.float64]) -> float:
    """Of (chains, draws); infinite where every half of a chain stands still at its own place.

    Of a single chain its halves are the chains. What takes two values, each half the time, is always as far
    from their middle: its spread says nothing.
    """
    chains = trace if len(trace) > 1 else _halves(trace)
    chains = chains[:, : chains.shape[1] // 2 * 2]
    halves = _halves(chains)
    if not np.ptp(halves, axis=1).any():
        return float("inf")
    spreads = np.ptp(np.abs(halves - np.median(halves)), axis=1)
    method = "rank" if spreads.any() else "z_scale"
    return float(np.asarray(array_stats.rhat(chains, method=method)))


def _halves(chains: NDArray[np.float64]) -> NDArray[np.float64]:
    """Both halves (2 chains, draws / 2) of each chain; of an odd number of draws the last is left out."""
    return chains[:, : chains.shape[1] // 2 * 2].reshape(2 * len(chains), -1)


def _samples(trace: NDArray[np.float64], method: str) -> float:
    """Effective number among (chains, draws); a tail that holds one value alone has as many as the bulk."""
    tail: dict[str, Any] = {"prob": TAILS} if method == "tail" else {}
    found = float(np.asarray(array_stats.ess(trace, method=method, **tail)))
    return found if np.isfinite(found) else float(np.asarray(array_stats.ess(trace, method="bulk")))


def _by_chain(samples: NDArray, scene: SceneResult) -> NDArray[np.float64]:
    """Samples (S, Q), chain after chain within a sweep, as (Q, chains, draws)."""
    chains = int(scene.chain.max(initial=0)) + 1
    return samples.reshape(-1, chains, samples.shape[1]).transpose(2, 1, 0).astype(np.float64)
