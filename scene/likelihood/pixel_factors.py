"""The factors of the density of an image: what a pixel shows, given those before it.

A pixel shows the nearest of the scene's surface at depth d and of what is unknown: with the unknown mixture
u of `scene.likelihood.unknown_surfaces` and the probability kappa that something unknown is there,

    p(z) = (1 - p0) { (1 - kappa U) [(1 - m) a(z) + m u(z)] + kappa u(z) Phi((d - z) / sigma) };  atom: p0

where U is the integral of u(z) Phi((d - z) / sigma), so that p integrates to 1, and m the probability that
the surface is not where it should be. The scene's part

    a(z) = eps / D + (1 - eps) [ sum_k v_k Normal(z; d + r_k, s_k) + (1 - sum_k v_k) Normal(z; d, sigma) ]

foretells the residual z - d as u foretells the depth: errors of neighbouring pixels are alike, so that those
before it that show the same surface foretell r_k, with the weights and scales of u. Where nothing is curved
both are as sharp. Whether a neighbour shows the surface is told by its own measurement alone, and so are
kappa and m: unknown things and errors come in pieces. An earlier frame that has measured what is there
foretells z itself, and tells of kappa, m and outlines, for frames share errors. Everything that a factor
looks at is the scene, a pixel before or an earlier frame, so that the product is a density of the images
(docs/model.md).

Pixels come in a list: an object covers a small part of an image, and a factor needs few pixels beside it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from recordings.types import NO_RETURN, DepthNoise
from scene.likelihood.causal_planes import fitted
from scene.likelihood.pixel_places import Near
from scene.likelihood.unknown_surfaces import (
    EDGES,
    NO_EDGE,
    UnknownSurfaces,
    drawn_normal,
    is_surprising,
    kept_parts,
    normal_density,
    normal_distribution,
    told_otherwise,
)
from shapes.depth_noise import standard_deviation

OUTLIERS = 0.02
"""eps: returns that are neither, uniform over the range. Chosen by hand."""
LEAST_DENSITY = 1e-8
"""Of a depth beyond the range, which no density allows; less than an outlier's, 2e-3."""
UNKNOWN, CHANGES = 0.5, 0.05
"""kappa where nothing was measured before, and the probability that a pixel's neighbour shows the scene
where it shows something unknown, or the other way round: what stands about is some ten pixels wide."""
APPEARS = CHANGES**2
"""The same from one frame to the next, where it is the same place that both see."""
MISSING, MISSING_ON = 0.002, 0.25
"""Probability that a surface ends before its outline, or is not there, at a pixel, and beside such pixels.
Counted on YCB-Video's 0001/10 and 0002/1 where their objects were found: 2 of 1,555 pixels, 1 of 4 beside."""


@dataclass(frozen=True)
class Surface:
    """A surface of the scene: depth, +inf where it is not, and its own error; arrays of any shape."""

    depth_m: jax.Array
    sigma_m: jax.Array

    @property
    def there(self) -> jax.Array:
        """Where it is."""
        return jnp.isfinite(self.depth_m)

    @property
    def finite_m(self) -> jax.Array:
        """Its depth, 1 where it is not."""
        return jnp.where(self.there, self.depth_m, 1.0)

    def measured_sigma_m(self, noise: DepthNoise) -> jax.Array:
        """Standard deviation of a measurement of it."""
        return jnp.hypot(standard_deviation(noise, self.finite_m), self.sigma_m)

    def shows(self, observed_m: jax.Array, noise: DepthNoise, reach_m: jax.Array | float) -> jax.Array:
        """Probability that a pixel shows it and nothing unknown, by its own measurement."""
        there = self.there & (observed_m != NO_RETURN)
        mine = normal_density(observed_m, self.finite_m, self.measured_sigma_m(noise))
        return jnp.where(there, mine / (mine + 1 / reach_m), 0.0)

    def residual_m(self, observed_m: jax.Array) -> jax.Array:
        """Observed depth less its own, 0 where it is not."""
        return jnp.where(self.there, observed_m - self.depth_m, 0.0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Shown:
    """What pixels would show of a surface, whatever else they may show.

    Attributes:
        there: (...) where it is.
        scene: (...) the scene's part a.
        missing: (...) probability that the surface is not where it should be.
        in_front: (...) Phi((d - z) / sigma).
        before: (...) each of what is foretold, as `PREDICTIONS` has it, and of what begins here, the
            probability that it is nearer.
    """

    there: jax.Array
    scene: jax.Array
    missing: jax.Array
    in_front: jax.Array
    before: list[jax.Array]


@dataclass(frozen=True)
class SurfaceBefore:
    """What the pixels beside listed ones show of a surface.

    Attributes:
        shows: with what probability, by their own measurement.
        residual_m: observed depth less the surface's, 0 where it is not.
        surprised: (P,) whether that to the left or that above was badly foretold.
    """

    shows: Near
    residual_m: Near
    surprised: jax.Array

    def foretold_m(self) -> jax.Array:
        """The residual (P,) that a plane through those before foretells."""
        plane_m, _, _ = fitted(lambda *by: (self.residual_m(*by), self.shows(*by)))
        return plane_m

    def badly_foretold(self, surface: Surface, noise: DepthNoise) -> jax.Array:
        """Whether the residuals (P,) of pixels that show the surface (P,) are far from what is foretold."""
        error_m = self.shows(0, 0) * (self.residual_m(0, 0) - self.foretold_m())
        return is_surprising(error_m, standard_deviation(noise, surface.finite_m))


@dataclass(frozen=True)
class Unknown:
    """What listed pixels may show that nobody asked for.

    Attributes:
        kappa: (P,) probability of something unknown.
        weights: (P,) each of what it may be, as `Shown.before` has it.
        density: (P,) u, at the observed depth.
    """

    kappa: jax.Array
    weights: list[jax.Array]
    density: jax.Array


@dataclass(frozen=True)
class EarlierPixels:
    """What an earlier frame has measured at listed pixels.

    Attributes:
        depth_m: (P,) `NO_RETURN` where nothing.
        weights, scales: (2, P) as `EarlierWeights` has them.
    """

    depth_m: jax.Array
    weights: jax.Array
    scales: jax.Array

    def of_surface(
        self, foretold_m: jax.Array, shows: jax.Array, noise: DepthNoise
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Weight, mean and deviation (P,) of what the frame foretells of a surface.

        Args:
            foretold_m: (P,) its depth by the pixels before.
            shows: (P,) probability that the frame shows it.
            noise: of the sensor.
        """
        depth_m, differs = told_otherwise(self.depth_m, foretold_m, True, noise)
        weight, scale = (jnp.where(differs > 0, far, near) for near, far in (self.weights, self.scales))
        return weight * shows, depth_m, scale * standard_deviation(noise, depth_m)

    def mixed(self, by_pixels: jax.Array, by_frame: jax.Array) -> jax.Array:
        """A probability (P,) by the pixels before and by the frame, which counts as where these differ."""
        weight = jnp.where(self.depth_m == NO_RETURN, 0.0, self.weights[1])
        return by_pixels + weight * (by_frame - by_pixels)


@dataclass(frozen=True)
class PixelFactors:
    """The factors of P listed pixels of one image or several; (1,) in place of (P,) what one image has alone.

    Attributes:
        noise: of the sensor of each, leaves (P,).
        edge_reach: (P,) by how much of the way to the next pixel cameras shift outlines.
        weights: (2, K + 1, P) of what foretells a surface's residuals: where those before were well foretold,
            and where one was not.
        scales: (K, P) of these, over the sensor's standard deviation.
        observed_m: (P,).
        unknown: what else the pixels may show, leaves (..., P).
        parts: (L + 1, P) as `ImageTerms` has them.
        shares: (L, P) likewise.
        measured: whether anything was measured beside them.
        earlier: what an earlier frame has measured; None where there is none.
    """

    noise: DepthNoise
    edge_reach: jax.Array
    weights: jax.Array
    scales: jax.Array
    observed_m: jax.Array
    unknown: UnknownSurfaces
    parts: jax.Array
    shares: jax.Array
    measured: Near
    earlier: EarlierPixels | None

    def shows_earlier(self, surface: Surface) -> jax.Array | None:
        """Probability (P,) that an earlier frame shows a surface (P,); None where there is none."""
        if self.earlier is None:
            return None
        return surface.shows(self.earlier.depth_m, self.noise, self.unknown.reach_m)

    def unknown_beside(
        self, scene: Near, objects: Near, earlier: tuple[jax.Array, jax.Array] | None
    ) -> Unknown:
        """What is unknown, where pixels beside show the scene, and its objects, with such probabilities.

        So does an earlier frame, two (P,), if there is one.
        """
        kept = kept_parts(objects(0, 1), objects(1, 0), objects(1, -self.unknown.columns))
        kappa = self._kappa(scene)
        if self.earlier is not None and earlier is not None:
            scene_earlier, objects_earlier = earlier
            kept.append(1 - objects_earlier)
            kappa = self.earlier.mixed(kappa, APPEARS + (1 - 2 * APPEARS) * (1 - scene_earlier))
        weights = [*kept, 1 - _weighted(kept, self.shares)]
        return Unknown(kappa, weights, _weighted(weights, self.parts))

    def shown(self, surface: Surface, before: SurfaceBefore) -> Shown:
        """What pixels show of a surface (P,)."""
        depth_m, sigma_m = surface.finite_m, surface.measured_sigma_m(self.noise)
        nearer = [
            *self.unknown.parts_before(depth_m, sigma_m),
            self.unknown.new_before(depth_m, sigma_m),
        ]
        return Shown(
            there=surface.there,
            scene=self._scene(surface, before),
            missing=self._missing(surface, before),
            in_front=normal_distribution((depth_m - self.observed_m) / sigma_m),
            before=nearer,
        )

    def density(self, shown: Shown, unknown: Unknown) -> jax.Array:
        """Density (P,) of pixels that show a surface, or nothing where there is none."""
        none_hit, none_miss = self.noise.none_hit_probability, self.noise.none_miss_probability
        kappa, u = unknown.kappa, unknown.density
        nearer = kappa * _weighted(unknown.weights, shown.before)
        a = (1 - shown.missing) * shown.scene + shown.missing * u
        hit = (1 - none_hit) * ((1 - nearer) * a + kappa * u * shown.in_front)
        miss = (1 - kappa) * (1 - none_miss) * self._uniform() + kappa * (1 - none_hit) * u
        none = jnp.where(shown.there, none_hit, (1 - kappa) * none_miss + kappa * none_hit)
        measured = jnp.where(shown.there, hit, miss)
        return jnp.maximum(jnp.where(self.observed_m == NO_RETURN, none, measured), LEAST_DENSITY)

    def drawn(self, key: jax.Array, surface: Surface, before: SurfaceBefore, unknown: Unknown) -> jax.Array:
        """Depths (P,) drawn of pixels that show a surface (P,), or what is unknown: the law of `density`."""
        keys = jax.random.split(key, 9)
        shape = unknown.kappa.shape
        chance = [jax.random.uniform(one, shape) for one in keys[:5]]
        thing, behind = (self.unknown.drawn(one, unknown.weights) for one in keys[5:7])
        error_m = surface.measured_sigma_m(self.noise) * jax.random.normal(keys[7], shape)
        is_thing = chance[0] < unknown.kappa
        anywhere = self.noise.max_range_m * chance[1]
        told = drawn_normal(keys[8], *map(jnp.stack, self._parts(surface, before)))
        seen = jnp.where(chance[2] < OUTLIERS, anywhere, told)
        seen = jnp.where(chance[3] < self._missing(surface, before), behind, seen)
        hit = jnp.where(is_thing & (thing < surface.finite_m + error_m), thing, seen)
        miss = jnp.where(is_thing, thing, anywhere)
        none_hit, none_miss = self.noise.none_hit_probability, self.noise.none_miss_probability
        none = jnp.where(surface.there | is_thing, none_hit, none_miss)
        return jnp.where(chance[4] < none, NO_RETURN, jnp.where(surface.there, hit, miss))

    def shifted(self, outline: Near, other: Near, other_earlier: jax.Array | None) -> jax.Array:
        """Probability (P,) that pixels at one side of an outline show its other side; 0 elsewhere.

        An outline is shifted with probability 1/2, as it was one pixel before but for `CHANGES`; where it is,
        `edge_reach` of its pixels show the other side, which tells of those before whether it is.

        Args:
            outline: these pixels.
            other: probability that they show the other side, by their own measurement.
            other_earlier: (P,) that an earlier frame does, if there is one.
        """
        told, seen = [], []
        for by in ((0, 1), (1, 0)):
            told.append(outline(*by) & self.measured(*by))
            seen.append(told[-1] * other(*by))
        count, seen_other = (jnp.asarray(sum(part), self.observed_m.dtype) for part in (told, seen))
        unseen = 0.5 * (1 - self.edge_reach) / (1 - 0.5 * self.edge_reach)
        before = unseen + (1 - unseen) * seen_other / jnp.maximum(count, 1.0)
        shifted = jnp.where(count > 0, CHANGES + (1 - 2 * CHANGES) * before, 0.5)
        share = self.edge_reach * shifted
        if self.earlier is not None and other_earlier is not None:
            share = self.earlier.mixed(share, CHANGES + (1 - 2 * CHANGES) * other_earlier)
        return jnp.where(outline(0, 0), share, 0.0)

    def _scene(self, surface: Surface, before: SurfaceBefore) -> jax.Array:
        """The scene's part a (P,)."""
        mixed = jnp.zeros_like(surface.depth_m)
        for weight, mean_m, spread_m in zip(*self._parts(surface, before), strict=True):
            mixed += weight * normal_density(self.observed_m, mean_m, spread_m)
        return OUTLIERS * self._uniform() + (1 - OUTLIERS) * mixed

    def _parts(
        self, surface: Surface, before: SurfaceBefore
    ) -> tuple[list[jax.Array], list[jax.Array], list[jax.Array]]:
        """Weights, means and deviations (P,) of what foretells the measurements of a surface."""
        depth_m = surface.finite_m
        sensor_m = standard_deviation(self.noise, depth_m)
        beside = (0, 1), (1, 0), (1, 1)
        left_m, above_m, corner_m = (before.residual_m(*by) for by in beside)
        left, above, corner = (before.shows(*by) for by in beside)
        plane_m, right = before.foretold_m(), before.shows(1, -1)
        calm, astir = self.weights
        by_plane, by_above_plane, by_left, by_above, wide, by_right_plane, by_three, _ = jnp.where(
            before.surprised, astir, calm
        )
        parts = (
            (by_plane + by_above_plane, plane_m, 0, 1 - (1 - left) * (1 - above)),
            (wide, plane_m, 4, 1 - (1 - left) * (1 - above)),
            (by_left, left_m, 2, left),
            (by_above, above_m, 3, above),
            (by_right_plane, plane_m, 5, right),
            (by_three, left_m + above_m - corner_m, 6, left * above * corner),
        )
        weights = [weight * share for weight, _, _, share in parts]
        means_m = [depth_m + foretold_m for _, foretold_m, _, _ in parts]
        spreads_m = [self.scales[scale] * sensor_m for _, _, scale, _ in parts]
        shows = self.shows_earlier(surface)
        if self.earlier is not None and shows is not None:
            weight, earlier_m, spread_m = self.earlier.of_surface(depth_m + plane_m, shows, self.noise)
            weights = [*((1 - weight) * other for other in weights), weight]
            means_m.append(earlier_m)
            spreads_m.append(spread_m)
        told = sum(weights, start=jnp.zeros_like(depth_m))
        spreads_m.append(surface.measured_sigma_m(self.noise))
        return [*weights, 1 - told], [*means_m, depth_m], spreads_m

    def _missing(self, surface: Surface, before: SurfaceBefore) -> jax.Array:
        """Probability (P,) that a surface is not where it should be: what is behind it is seen there.

        Shapes, calibration and outlines are wrong in pieces.
        """
        left, above = (
            jnp.where(before.residual_m(*by) > 0, 1 - before.shows(*by), 0.0) for by in ((0, 1), (1, 0))
        )
        missing = MISSING + (MISSING_ON - MISSING) * (left + above) / 2
        shows = self.shows_earlier(surface)
        if self.earlier is None or shows is None:
            return missing
        ended = jnp.where(self.earlier.depth_m > surface.finite_m, 1 - shows, 0.0)
        return self.earlier.mixed(missing, MISSING + (1 - 2 * MISSING) * ended)

    def _kappa(self, scene: Near) -> jax.Array:
        """Probability (P,) of something unknown, by what the pixels before show of the scene.

        Outlines go on as they came: where the pixel to the left shows what the one above it does, this one
        shows what the one above does, and the same with rows and columns changed. A thing begins where all
        three show the scene with probability `CHANGES` along the row times the same along the column.
        """
        left, above, corner = (scene(*by) for by in ((0, 1), (1, 0), (1, 1)))
        known_left, known_above, known_corner = (self.measured(*by) for by in ((0, 1), (1, 0), (1, 1)))
        count = known_left.astype(left.dtype) + known_above
        mean = (known_left * left + known_above * above) / jnp.maximum(count, 1.0)
        goes_on = known_left & known_above & known_corner
        known = jnp.where(goes_on, jnp.clip(left + above - corner, 0.0, 1.0), mean)
        begins = jnp.where(goes_on, CHANGES ** (1 + left * above * corner), CHANGES)
        return jnp.where(count > 0, begins + (1 - begins - CHANGES) * (1 - known), UNKNOWN)

    def _uniform(self) -> jax.Array:
        range_m = self.noise.max_range_m
        return ((self.observed_m >= 0) & (self.observed_m <= range_m)) / range_m


def _weighted(weights: Iterable[jax.Array], parts: Iterable[jax.Array]) -> jax.Array:
    """The sum (P,) of parts (P,) with weights (P,)."""
    return jnp.asarray(sum(weight * part for weight, part in zip(weights, parts, strict=True)))


def calm_and_astir(weights: jax.Array) -> jax.Array:
    """Those (..., 2, K + 1) of unknown weights (..., KINDS, K + 1) by which surfaces foretell residuals."""
    return weights[..., (NO_EDGE, NO_EDGE + EDGES), :]
