"""Density of colour given what is rendered: shaded albedo with noise and outliers, albedo integrated out.

A channel y of a pixel of which a thing fills the share w, with shade s and colour m, and other things and the
table the rest, of mean colour b and variance v:

    p(y | a) = (1 - p_out) Normal(y; w s m a + (1 - w) b, sd) + p_out 1[0 <= y <= 1]
    sd^2 = sigma^2 + (1 - w)^2 v + [4 coverage w (1 - w) (s m a - b)]^2 + (w u a)^2

The third term is for outlines that are not quite where they are rendered, the last one, of deviation u, for
edges within a thing: s m is rendered at the pixel's centre. Nothing is clipped; where a camera
did, the value is infinite, and counts for all that is as bright, or as dark. An object has one a per channel.
Where its colours are unknown m is 1 and a its albedo, a ~ Normal(0.5, 0.3); where they are known m is its
surface's and a the gain of the light there, log a ~ Normal(0, 0.3). Channels part, so that integrating it out
is one quadrature each, over all pixels of the object together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

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
VOTES = 0.5
"""Share that a thing fills of the pixels that vote."""
FITS = 5
"""Steps of expectation and maximisation after the vote; the last changes an albedo by under 1e-4."""
FITS_OF_MANY = 3
"""The same where many things are tried; two more change evidences by 0.05 nats."""
STORED = 256
"""Values of a channel; an outlier takes each as likely."""
LEAST = 1e-30
"""Density of a value outside [0, 1] far from what was rendered, in place of zero."""


@dataclass(frozen=True, kw_only=True)
class ColourNoise:
    """Noise of colours in 0..1 and the prior of unknown albedos.

    Attributes:
        sigma: standard deviation of a channel.
        outlier: probability that a channel tells nothing (dead pixels, highlights).
        coverage: standard deviation of the share that a thing fills of a pixel, where that is one half.
        albedo_mean: of the prior.
        albedo_sd: of the prior.
        gain_sd: of the logarithm of a channel's gain, where colours are known: lamps and white balances
            differ by a third.
    """

    sigma: float = 0.03
    outlier: float = 0.05
    coverage: float = 0.05
    albedo_mean: float = 0.5
    albedo_sd: float = 0.3
    gain_sd: float = 0.3

    def blurred(self, times: float) -> ColourNoise:
        """So many times the noise, 1 at most."""
        return replace(self, sigma=min(times * self.sigma, 1.0))

    def __post_init__(self) -> None:
        check_finite(self)
        check_within(self, 1e-4, 1.0, ("sigma", "albedo_sd", "gain_sd"))
        check_within(self, 0.0, 1.0, ("coverage",))
        check_within(self, 1e-6, 0.999, ("outlier",))


def log_density(
    colour: NDArray[np.floating],
    rendered: NDArray[np.floating],
    noise: ColourNoise,
    sd: NDArray[np.floating] | None = None,
) -> NDArray[np.floating]:
    """Log density of each channel given its rendered value; arrays that broadcast.

    Lebesgue measure, and for what was clipped, +inf or -inf, the probability of a value over 1 or below 0.

    Args:
        colour: +inf or -inf where it was clipped.
        rendered: mean.
        noise: of the channel.
        sd: standard deviation of what is no outlier; None takes the noise's own.
    """
    narrow = 1 / (noise.sigma if sd is None else sd)
    residual = (colour - rendered) * narrow
    density = (1 - noise.outlier) / np.sqrt(2 * np.pi) * narrow * np.exp(-0.5 * residual * residual)
    density = density + noise.outlier * ((colour >= 0) & (colour <= 1))
    clipped = np.isinf(colour)
    if clipped.any():
        beyond = ndtr(np.where(colour > 0, rendered - 1, -rendered) * narrow)
        density = np.where(clipped, (1 - noise.outlier) * beyond + noise.outlier / STORED, density)
    return np.log(np.maximum(density, LEAST))


@dataclass(frozen=True, eq=False)
class Segments:
    """Pixels of B objects, those of object b in rows `start[b]` to `start[b + 1]`.

    Attributes:
        start: (B + 1,).
        colour: (P, C) in 0..1.
        lit: (P, C), or (P, 1) for all channels: the shade, times the surface's colour where it is known.
        is_known: (B,) whether it is.
        share: (P, 1) that the object fills of the pixel.
        base: (P, C) what the rest of the pixel adds to its colour: `(1 - share)` of its mean.
        variance: (P, C) of what it adds; None for none.
        unresolved: (P, C or 1) standard deviation of `lit`; None takes edges, and outlines, as they are
            rendered.
    """

    start: NDArray[np.int64]
    colour: NDArray[np.floating]
    lit: NDArray[np.floating]
    is_known: NDArray[np.bool_]
    share: NDArray[np.floating]
    base: NDArray[np.floating]
    variance: NDArray[np.floating] | None
    unresolved: NDArray[np.floating] | None

    @property
    def owner(self) -> NDArray[np.int64]:
        """Object (P,) of each pixel."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))

    @cached_property
    def own(self) -> NDArray[np.floating]:
        """What the object adds (P, C or 1) to each pixel, over its factor."""
        return self.share * self.lit

    def of(self, chosen: NDArray[np.bool_]) -> Segments:
        """Those of some objects (B,), in order."""
        counts = np.diff(self.start)
        rows = np.repeat(chosen, counts)
        start = np.concatenate([[0], np.cumsum(counts[chosen])])
        others = (None if one is None else one[rows] for one in (self.variance, self.unresolved))
        pixels = (self.share[rows], self.base[rows], *others)
        return Segments(start, self.colour[rows], self.lit[rows], self.is_known[chosen], *pixels)

    def variances(self, factor: NDArray[np.floating], noise: ColourNoise) -> NDArray[np.floating] | float:
        """Of colours (P, C, ...), given the factors (P, C, ...) of their objects."""
        if self.unresolved is None:
            return noise.sigma**2
        beyond = (...,) + (None,) * (factor.ndim - 2)
        edge = (self.share * self.unresolved)[beyond] * factor
        jump = 4 * noise.coverage * ((1 - self.share) * self.own)[beyond] * factor
        jump -= (4 * noise.coverage * self.share * self.base)[beyond]
        jump *= jump
        jump += edge * edge
        jump += noise.sigma**2 + (0.0 if self.variance is None else self.variance[beyond])
        return jump


def factor_prior(
    is_known: NDArray[np.bool_], noise: ColourNoise
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and standard deviation (...) of albedos, or of a Gaussian near the prior of gains."""
    mean = np.where(is_known, 1.0, noise.albedo_mean)
    return mean, np.where(is_known, noise.gain_sd, noise.albedo_sd)


def sample(
    rng: np.random.Generator,
    rendered: NDArray[np.floating],
    noise: ColourNoise,
    sd: NDArray[np.floating] | None = None,
) -> NDArray[np.float64]:
    """Draws from `log_density`, of the shape of `rendered`."""
    spread = noise.sigma if sd is None else sd
    drawn = rendered + spread * rng.standard_normal(rendered.shape)
    return np.where(rng.random(rendered.shape) < noise.outlier, rng.random(rendered.shape), drawn)


@dataclass(frozen=True, eq=False)
class Fit:
    """The most probable factors of B objects.

    Attributes:
        factor: (B, C) albedos, or gains.
        precision: (B, C) of them.
        residual: (P, C) colours less what is rendered; 0 of what was clipped.
        variance: (P, C) of colours, or a number.
        weight: (P, C) precisions of the colours, as far as they are no outliers.
    """

    factor: NDArray[np.float64]
    precision: NDArray[np.float64]
    residual: NDArray[np.floating]
    variance: NDArray[np.floating] | float
    weight: NDArray[np.floating]


def fit(segments: Segments, noise: ColourNoise, steps: int = FITS) -> Fit:
    """A vote, then expectation and maximisation."""
    mean, sd = factor_prior(segments.is_known[:, None], noise)
    factor, precision = _voted(segments, mean), np.zeros(mean.shape) + sd**-2
    rest = segments.colour - segments.base
    clipped = np.isinf(segments.colour)
    any_clipped = bool(clipped.any())
    if any_clipped:
        rest[clipped] = 0.0
    expected = _expected(segments, noise, factor, rest)
    for _ in range(steps):
        pull = np.where(clipped, 0.0, expected[2]) if any_clipped else expected[2]
        pull = pull * segments.own
        precision = sd**-2 + sums(segments.start, pull * segments.own)
        factor = (mean * sd**-2 + sums(segments.start, pull * rest)) / precision
        factor = np.where(segments.is_known[:, None], np.maximum(factor, DIMMEST), factor)
        expected = _expected(segments, noise, factor, rest)
    residual, variance, weight = expected
    if any_clipped:
        residual, weight = (np.where(clipped, 0.0, one) for one in (residual, weight))
    return Fit(factor, precision, residual, variance, weight)


def _expected(
    segments: Segments, noise: ColourNoise, factor: NDArray[np.float64], rest: NDArray[np.floating]
) -> tuple[NDArray[np.floating], NDArray[np.floating] | float, NDArray[np.floating]]:
    """Residuals, variances and weights (P, C), given factors (B, C) and the things' own part (P, C)."""
    mine = factor[segments.owner]
    residual, variance = rest - segments.own * mine, segments.variances(mine, noise)
    peak = (1 - noise.outlier) / np.sqrt(2 * np.pi * variance)
    inlier = peak * np.exp(residual * residual * (-0.5 / variance))
    return residual, variance, inlier / ((inlier + noise.outlier) * variance)


def laplace_evidence(
    segments: Segments, noise: ColourNoise, fitted: Fit | None = None
) -> NDArray[np.float64]:
    """Log evidence (B,) by a Gaussian at the most probable factors (B, C); for searching."""
    fitted = fit(segments, noise) if fitted is None else fitted
    rendered = segments.own * fitted.factor[segments.owner] + segments.base
    density = log_density(segments.colour, rendered, noise, np.sqrt(fitted.variance))
    joint = sums(segments.start, density) + _log_prior(fitted.factor, segments.is_known[:, None], noise)
    evidence = joint + 0.5 * np.log(2 * np.pi / fitted.precision)
    return np.where(np.diff(segments.start) > 0, evidence.sum(axis=1), 0.0)


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
    fitted = fit(segments, noise)
    albedo, narrow, known = fitted.factor, fitted.precision**-0.5, segments.is_known[:, None]
    spread = REACH * noise.albedo_sd
    low = np.where(known, 0.0, noise.albedo_mean - spread)
    high = np.where(known, np.exp(REACH * noise.gain_sd), noise.albedo_mean + spread)
    span = np.maximum(albedo - low, high - albedo)
    furthest = np.arcsinh(span / narrow)
    u = furthest[..., None] * np.linspace(-1, 1, count)
    nodes = albedo[..., None] + narrow[..., None] * np.sinh(u)  # (B, C, Q)
    log_weight = np.log(narrow[..., None] * np.cosh(u) * (2 / (count - 1) * furthest)[..., None])
    mine = nodes[segments.owner]
    rendered, variance = segments.own[..., None] * mine, segments.variances(mine, noise)
    rendered += segments.base[..., None]
    density = log_density(segments.colour[..., None], rendered, noise, np.sqrt(variance))
    joint = sums(segments.start, density) + _log_prior(nodes, known[..., None], noise) + log_weight
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
    ratio = (colour - segments.base) / np.maximum(segments.own, 1e-3)
    cell = np.clip(np.floor(ratio / BIN).astype(np.int64) + CELLS // 4, 0, CELLS - 1)
    place = (segments.owner[:, None] * channels + np.arange(channels)) * CELLS + cell
    vote = np.broadcast_to(segments.share > VOTES, place.shape)
    votes = np.bincount(place.ravel(), vote.ravel(), minlength=objects * channels * CELLS)
    votes = np.pad(votes.reshape(objects, channels, CELLS), ((0, 0), (0, 0), (1, 1)))
    best = (votes[..., :-2] + 2 * votes[..., 1:-1] + votes[..., 2:]).argmax(axis=-1)
    albedo = (best - CELLS // 4 + 0.5) * BIN
    return np.where(sums(segments.start, vote[:, :1].astype(np.float64)) > 0, albedo, mean)


def sums(start: NDArray[np.int64], rows: NDArray[np.floating]) -> NDArray[np.float64]:
    """Sums (B, ...) of rows by object; zero for objects without rows."""
    sums = np.zeros((len(start) - 1, *rows.shape[1:]))
    filled = np.diff(start) > 0
    if filled.any():
        sums[filled] = np.add.reduceat(rows, start[:-1][filled], axis=0)
    return sums
