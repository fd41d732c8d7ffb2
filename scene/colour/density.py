"""Density of colour given what is rendered: shaded albedo with noise and outliers, albedo integrated out.

A channel y of a pixel whose surface has shade s and colour m:

    p(y | s, a) = (1 - p_out) Normal(y; s m a, sigma) + p_out 1[0 <= y <= 1]

Nothing is clipped; where a camera did, the value is infinite, and counts for all that is as bright, or as
dark. An object has one a per channel. Where its colours are unknown m is 1 and a its albedo, a ~ Normal(0.5,
0.3); where they are known m is its surface's and a the gain of the light there, log a ~ Normal(0, 0.3).
Channels part, so that integrating it out is one quadrature each, over all pixels of the object together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from recordings.settings import check_finite, check_within

NODES = 64
"""Of the quadrature; sums over 20,000 points differ by less than 1e-8."""
FEW = 16
"""Objects of fewer pixels may have several narrow modes of like weight, ..."""
NODES_OF_FEW = 512
"""... which this many nodes resolve to the same 1e-8 all over the prior."""
REACH = 6.0
"""Standard deviations of the albedo's prior round its mean, or of a gain's logarithm, that the nodes span."""
DIMMEST = 1e-3
"""Gain that is fitted at least."""
BIN = 0.05
"""Width of the cells in which pixels vote for an albedo."""
CELLS = 40
"""Cells from -BIN * 10 on: albedos above 1.5 are six times fainter in the prior than at its mean."""
FITS = 5
"""Steps of expectation and maximisation after the vote; the last changes an albedo by under 1e-4."""
STORED = 256
"""Values of a channel; an outlier takes each as likely."""
LEAST = 1e-30
"""Density of a value outside [0, 1] far from what was rendered, in place of zero."""


@dataclass(frozen=True, kw_only=True)
class ColourNoise:
    """Noise of colours in 0..1 and the prior of unknown albedos.

    Attributes:
        sigma: standard deviation of a channel.
        outlier: probability that a channel tells nothing (mixed pixels at silhouettes, highlights).
        albedo_mean: of the prior.
        albedo_sd: of the prior.
        gain_sd: of the logarithm of a channel's gain, where colours are known: lamps and white balances
            differ by a third.
    """

    sigma: float = 0.03
    outlier: float = 0.05
    albedo_mean: float = 0.5
    albedo_sd: float = 0.3
    gain_sd: float = 0.3

    def __post_init__(self) -> None:
        check_finite(self)
        check_within(self, 1e-4, 1.0, ("sigma", "albedo_sd", "gain_sd"))
        check_within(self, 1e-6, 0.999, ("outlier",))


def log_density(
    colour: NDArray[np.floating], rendered: NDArray[np.floating], noise: ColourNoise
) -> NDArray[np.floating]:
    """Log density of each channel given its rendered value; arrays that broadcast.

    Lebesgue measure, and for what was clipped, +inf or -inf, the probability of a value over 1 or below 0.
    """
    peak = (1 - noise.outlier) / (noise.sigma * np.sqrt(2 * np.pi))
    residual = (colour - rendered) * (1 / noise.sigma)
    uniform = noise.outlier * ((colour >= 0) & (colour <= 1))
    density = peak * np.exp(-0.5 * residual * residual) + uniform
    clipped = np.isinf(colour)
    if clipped.any():
        beyond = ndtr(np.where(colour > 0, rendered - 1, -rendered) / noise.sigma)
        density = np.where(clipped, (1 - noise.outlier) * beyond + noise.outlier / STORED, density)
    return np.log(np.maximum(density, LEAST))


def sample(
    rng: np.random.Generator, rendered: NDArray[np.floating], noise: ColourNoise
) -> NDArray[np.float64]:
    """Draws from `log_density`, of the shape of `rendered`."""
    drawn = rendered + noise.sigma * rng.standard_normal(rendered.shape)
    return np.where(rng.random(rendered.shape) < noise.outlier, rng.random(rendered.shape), drawn)


@dataclass(frozen=True, eq=False)
class Segments:
    """Pixels of B objects, those of object b in rows `start[b]` to `start[b + 1]`.

    Attributes:
        start: (B + 1,).
        colour: (P, C) in 0..1.
        lit: (P, C), or (P, 1) for all channels: the shade, times the surface's colour where it is known.
        is_known: (B,) whether it is.
    """

    start: NDArray[np.int64]
    colour: NDArray[np.floating]
    lit: NDArray[np.floating]
    is_known: NDArray[np.bool_]

    @property
    def owner(self) -> NDArray[np.int64]:
        """Object (P,) of each pixel."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))

    def of(self, chosen: NDArray[np.bool_]) -> Segments:
        """Those of some objects (B,), in order."""
        counts = np.diff(self.start)
        rows = np.repeat(chosen, counts)
        start = np.concatenate([[0], np.cumsum(counts[chosen])])
        return Segments(start, self.colour[rows], self.lit[rows], self.is_known[chosen])

    def prior(self, noise: ColourNoise) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean and standard deviation (B, 1) of a Gaussian that is, or is near, the prior of the factor a."""
        mean = np.where(self.is_known, 1.0, noise.albedo_mean)
        return mean[:, None], np.where(self.is_known, noise.gain_sd, noise.albedo_sd)[:, None]


def fitted_albedo(segments: Segments, noise: ColourNoise) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Most probable albedo, or gain, and its precision, (B, C): a vote, then expectation and maximisation."""
    mean, sd = segments.prior(noise)
    albedo = _voted(segments, mean)
    lit, owner = segments.lit, segments.owner
    told = np.isfinite(segments.colour)
    colour = np.where(told, segments.colour, 0.0)
    precision = np.zeros_like(albedo) + sd**-2
    peak = (1 - noise.outlier) / (noise.sigma * np.sqrt(2 * np.pi))
    for _ in range(FITS):
        residual = (colour - lit * albedo[owner]) * (1 / noise.sigma)
        inlier = told * peak * np.exp(-0.5 * residual * residual)
        weight = inlier / (inlier + noise.outlier) * (lit / noise.sigma**2)
        precision = sd**-2 + _sums(segments.start, weight * lit)
        albedo = (mean * sd**-2 + _sums(segments.start, weight * colour)) / precision
    return np.where(segments.is_known[:, None], np.maximum(albedo, DIMMEST), albedo), precision


def laplace_evidence(
    segments: Segments, noise: ColourNoise
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Log evidence (B,) by a Gaussian at the most probable albedo (B, C), and that albedo; for searching."""
    albedo, precision = fitted_albedo(segments, noise)
    density = log_density(segments.colour, segments.lit * albedo[segments.owner], noise)
    joint = _sums(segments.start, density) + _log_prior(albedo, segments.is_known[:, None], noise)
    evidence = joint + 0.5 * np.log(2 * np.pi / precision)
    return np.where(np.diff(segments.start) > 0, evidence.sum(axis=1), 0.0), albedo


def albedo_evidence(segments: Segments, noise: ColourNoise) -> NDArray[np.float64]:
    """Log evidence (B,): log int prod_p p(y_p | s_p, a) p(a) da, summed over channels; 0 without pixels.

    Nodes a + d sinh(u) lie close where the integrand is narrow and reach over the whole prior, where its
    outliers keep it from falling: the trapezoid rule in u.
    """
    few = np.diff(segments.start) < FEW
    evidence = np.zeros(len(few))
    for chosen, nodes in ((few, NODES_OF_FEW), (~few, NODES)):
        if chosen.any():
            evidence[chosen] = _quadrature(segments.of(chosen), noise, nodes)
    return evidence


def _quadrature(segments: Segments, noise: ColourNoise, count: int) -> NDArray[np.float64]:
    albedo, precision = fitted_albedo(segments, noise)
    narrow, known = precision**-0.5, segments.is_known[:, None]
    spread = REACH * noise.albedo_sd
    low = np.where(known, 0.0, noise.albedo_mean - spread)
    high = np.where(known, np.exp(REACH * noise.gain_sd), noise.albedo_mean + spread)
    span = np.maximum(albedo - low, high - albedo)
    furthest = np.arcsinh(span / narrow)
    u = furthest[..., None] * np.linspace(-1, 1, count)
    nodes = albedo[..., None] + narrow[..., None] * np.sinh(u)  # (B, C, Q)
    log_weight = np.log(narrow[..., None] * np.cosh(u) * (2 / (count - 1) * furthest)[..., None])
    rendered = segments.lit[..., None] * nodes[segments.owner]
    density = log_density(segments.colour[..., None], rendered, noise)
    joint = _sums(segments.start, density) + _log_prior(nodes, known[..., None], noise) + log_weight
    most = joint.max(axis=-1)
    return (most + np.log(np.exp(joint - most[..., None]).sum(axis=-1))).sum(axis=1)


def _log_prior(
    factor: NDArray[np.float64], is_known: NDArray[np.bool_], noise: ColourNoise
) -> NDArray[np.float64]:
    """Normal for albedos, log-normal of median 1 for gains, by Lebesgue measure on the factor."""
    log_factor = np.log(np.maximum(factor, LEAST))
    scaled = np.where(is_known, log_factor / noise.gain_sd, (factor - noise.albedo_mean) / noise.albedo_sd)
    sd = np.where(is_known, noise.gain_sd * np.maximum(factor, LEAST), noise.albedo_sd)
    return -0.5 * scaled * scaled - np.log(sd * np.sqrt(2 * np.pi))


def _voted(segments: Segments, mean: NDArray[np.float64]) -> NDArray[np.float64]:
    """The albedo (B, C) for which most pixels vote; the prior's mean (B, 1) without pixels."""
    objects, channels = len(segments.start) - 1, segments.colour.shape[1]
    colour = np.nan_to_num(segments.colour, posinf=1.0, neginf=0.0)
    ratio = colour / np.maximum(segments.lit, 1e-3)
    cell = np.clip(np.floor(ratio / BIN).astype(np.int64) + CELLS // 4, 0, CELLS - 1)
    place = (segments.owner[:, None] * channels + np.arange(channels)) * CELLS + cell
    votes = np.bincount(place.ravel(), minlength=objects * channels * CELLS)
    votes = np.pad(votes.reshape(objects, channels, CELLS), ((0, 0), (0, 0), (1, 1)))
    best = (votes[..., :-2] + 2 * votes[..., 1:-1] + votes[..., 2:]).argmax(axis=-1)
    albedo = (best - CELLS // 4 + 0.5) * BIN
    return np.where(np.diff(segments.start)[:, None] > 0, albedo, mean)


def _sums(start: NDArray[np.int64], rows: NDArray[np.floating]) -> NDArray[np.float64]:
    """Sums (B, ...) of rows by object; zero for objects without rows."""
    sums = np.zeros((len(start) - 1, *rows.shape[1:]))
    filled = np.diff(start) > 0
    if filled.any():
        sums[filled] = np.add.reduceat(rows, start[:-1][filled], axis=0)
    return sums
