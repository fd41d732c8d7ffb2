"""A density of a depth image given a scene: a product over pixels in raster order.

A pixel shows the nearest of the scene's surface at depth d and of what is unknown: with the unknown mixture
u of `scene.likelihood.unknown_surfaces` and the probability kappa that something unknown is there,

    p(z) = (1 - p0) { (1 - kappa U) [(1 - m) a(z) + m u(z)] + kappa u(z) Phi((d - z) / sigma) };  atom: p0

where U is the integral of u(z) Phi((d - z) / sigma), so that p integrates to 1, and m the probability that
the surface is not where it should be. The scene's part

    a(z) = eps / D + (1 - eps) [ sum_k v_k Normal(z; d + r_k, s_k) + (1 - sum_k v_k) Normal(z; d, sigma) ]

foretells the residual z - d as u foretells the depth: errors of neighbouring pixels are alike, so that those
before it that show the same surface foretell r_k, with the weights and scales of u. Where nothing is curved
both are as sharp. Whether a neighbour shows the surface is told by its own measurement alone, and so are
kappa and m: unknown things and errors come in pieces. Everything that a factor looks at is the scene or a
pixel before, so that the product is a density of the image (docs/model.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN, DepthNoise
from scene.execution import FAST_COMPILE
from scene.likelihood.causal_planes import fitted, shifted, shifts
from scene.likelihood.unknown_surfaces import (
    EDGES,
    NO_EDGE,
    UnknownSurfaces,
    UnknownWeights,
    drawn_normal,
    kept_parts,
    normal_density,
    normal_distribution,
    surprised,
)
from shapes.depth_noise import standard_deviation

OUTLIERS = 0.02
"""eps: returns that are neither, uniform over the range. Chosen by hand."""
SUPPORT_ERROR = 0.01
"""Error of a support over its depth, which is a depth camera's scale and bend."""
LEAST_DENSITY = 1e-8
"""Of a depth beyond the range, which no density allows; less than an outlier's, 2e-3."""
UNKNOWN, CHANGES = 0.5, 0.05
"""kappa where nothing was measured before, and the probability that a pixel's neighbour shows the scene
where it shows something unknown, or the other way round: what stands about is some ten pixels wide."""
JUST_BEFORE, FAR_M = 1 - 1e-6, 1e6
"""What an object does to the pixels beside it is behind all objects and before the supports."""
MISSING, MISSING_ON = 0.002, 0.25
"""Probability that a surface ends before its outline, or is not there, at a pixel, and beside such pixels.
Counted on YCB-Video's 0001/10 and 0002/1 where their objects were found: 2 of 1,555 pixels, 1 of 4 beside."""
EDGE_PX = 3.0
"""Pixels of an image by which cameras shift outlines."""

Images = TypeVar("Images")


@dataclass(frozen=True)
class _Surface:
    """A surface of the scene: depth (H, W), +inf where it is not, and its own error."""

    depth_m: jax.Array
    sigma_m: jax.Array

    @property
    def there(self) -> jax.Array:
        return jnp.isfinite(self.depth_m)

    @property
    def finite_m(self) -> jax.Array:
        return jnp.where(self.there, self.depth_m, 1.0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ObjectPixels:
    """The pixels that an object has a part in, whatever is measured there; leaves (H, W).

    Attributes:
        covers: where it is nearer than the supports.
        inner: those at its outline.
        wide_m: its depth, and beside it that of the nearest pixel of its outline; +inf elsewhere.
        shown_m: its depth; of the two pixels beside it, which tell that no unknown surface goes on from it,
            just before the supports, so that other objects hide them.
    """

    covers: jax.Array
    inner: jax.Array
    wide_m: jax.Array
    shown_m: jax.Array

    @property
    def touches(self) -> jax.Array:
        """Where it is, or ends beside."""
        return jnp.isfinite(self.wide_m)

    @classmethod
    def of(cls, layer_m: jax.Array, rest_m: jax.Array) -> ObjectPixels:
        """Of the depth (H, W) of an object alone, +inf beside it, before supports (H, W)."""
        covers = layer_m < rest_m
        layer_m = jnp.where(covers, layer_m, jnp.inf)
        nearest_m = _nearest_beside(layer_m)
        wide_m = jnp.where(covers, layer_m, jnp.where(nearest_m < rest_m, nearest_m, jnp.inf))
        touches = jnp.isfinite(wide_m)
        beside = touches | sum(_left_and_above(touches)) | shifted(touches, 1, -1)
        just_before = jnp.where(jnp.isfinite(rest_m), rest_m * JUST_BEFORE, FAR_M)
        shown_m = jnp.where(covers, layer_m, jnp.where(beside, just_before, jnp.inf))
        return cls(covers, covers & ~_all_beside(covers), wide_m, shown_m)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Shown:
    """What pixels would show of a surface, whatever else they may show.

    Attributes:
        there: (H, W) where it is.
        scene: (H, W) the scene's part a.
        missing: (H, W) probability that the surface is not where it should be.
        in_front: (H, W) Phi((d - z) / sigma).
        before: (5, H, W) of what both neighbours, the left, the upper, the upper right one foretell, and of
            what begins here, the probability that it is nearer.
    """

    there: jax.Array
    scene: jax.Array
    missing: jax.Array
    in_front: jax.Array
    before: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ImageTerms:
    """What the density of every scene takes from an image and its supports; leaves (..., H, W).

    Attributes:
        observed_m: `NO_RETURN` where nothing was measured.
        rest_m: depth of the supports, +inf where none is.
        unknown: what else the pixels may show.
        parts: (5, H, W) density at the observed depth of what both neighbours, the left, the upper, the upper
            right one foretell of unknown things, and of one that begins here.
        shares: (4, H, W) weights of the first four.
        behind: probability that a pixel shows the supports.
        rest: what pixels show of the supports.
    """

    observed_m: jax.Array
    rest_m: jax.Array
    unknown: UnknownSurfaces
    parts: jax.Array
    shares: jax.Array
    behind: jax.Array
    rest: _Shown


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PixelDensity:
    """The density of one image, ready for scenes.

    Attributes:
        noise: of the sensor.
        shape_sigma_m: error of objects' surfaces.
        edge_reach: by how much of the way from one of these pixels to the next cameras shift outlines.
        learned: how well pixels foretell each other.
        image: what is the same for all scenes.
        log_rest: (H, W) log density where no object is.
    """

    noise: DepthNoise
    shape_sigma_m: jax.Array
    edge_reach: jax.Array
    learned: UnknownWeights
    image: ImageTerms
    log_rest: jax.Array

    @classmethod
    def of(
        cls,
        depth_m: NDArray[np.float32],
        rest_m: NDArray[np.float32],
        noise: DepthNoise,
        shape_sigma_m: float,
        stride: int,
        learned: UnknownWeights | None = None,
    ) -> PixelDensity:
        """The density of every `stride`-th pixel (H, W) of an image.

        Args:
            depth_m: of these pixels.
            rest_m: (H, W) of the supports, +inf where none is.
            noise: of the sensor.
            shape_sigma_m: error of objects' surfaces.
            stride: pixels of the image from one of these to the next.
            learned: how well they foretell each other; None learns it from these pixels.
        """
        learned = learned or UnknownWeights.learned([depth_m], noise)
        numbers = noise, shape_sigma_m, min(1.0, EDGE_PX / stride), learned
        with jax.enable_x64(False):
            return _of_image(depth_m, rest_m, *jax.tree.map(np.float32, numbers))

    @classmethod
    def of_image(
        cls,
        observed_m: jax.Array,
        rest_m: jax.Array,
        noise: DepthNoise,
        shape_sigma_m: jax.Array,
        edge_reach: jax.Array,
        learned: UnknownWeights,
    ) -> PixelDensity:
        """The density of an image (H, W) before supports (H, W) with all that is learned of its sensor."""
        unknown = UnknownSurfaces.of(observed_m, noise, learned)
        parts = [*unknown.density_parts(observed_m), unknown.new_density(observed_m)]
        blank = jnp.zeros_like(observed_m)
        nothing = _Shown(blank, blank, blank, blank, blank)
        terms = ImageTerms(observed_m, rest_m, unknown, jnp.stack(parts), unknown.shares(), blank, nothing)
        density = cls(noise, shape_sigma_m, edge_reach, learned, terms, blank)
        rest = density._rest()
        behind = density._shows(rest)
        terms = replace(terms, behind=behind, rest=density._shown(rest, behind))
        density = replace(density, image=terms)
        log_rest = jnp.log(density._density(terms.rest, density._unknown(behind, blank)))
        return replace(density, log_rest=log_rest)

    def of_object(self, layer_m: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Log density (H, W) of the pixels that an object has a part in, and its depth there, else +inf.

        A camera shifts outlines: at one a pixel may show the other side of it, and most so beside others that
        do. Where the object ends no unknown surface goes on from it, which two pixels beside it tell.

        Args:
            layer_m: (H, W) depth of the object alone, +inf beside it.
        """
        pixels = ObjectPixels.of(layer_m, self.image.rest_m)
        one = self._surface_of(pixels)
        mine = _computed(self._shows(one))
        scene = _computed(jnp.maximum(mine, self.image.behind))
        unknown = _computed(self._unknown(scene, mine))
        share = self._share(pixels, mine)
        own, other = self._density(self._shown(one, mine), unknown), self._density(self.image.rest, unknown)
        return jnp.log(share * own + (1 - share) * other), pixels.shown_m

    def drawn(self, key: jax.Array, pixels: ObjectPixels) -> jax.Array:
        """Every pixel (H, W) drawn given those before it, cause by cause: the law whose density this is.

        Args:
            key: random key.
            pixels: of the object that they have a part in.
        """
        side_key, own_key, other_key = jax.random.split(key, 3)
        one = self._surface_of(pixels)
        mine = self._shows(one)
        unknown = self._unknown(jnp.maximum(mine, self.image.behind), mine)
        own = self._drawn_surface(own_key, one, mine, unknown)
        other = self._drawn_surface(other_key, self._rest(), self.image.behind, unknown)
        is_own = jax.random.uniform(side_key, mine.shape) < self._share(pixels, mine)
        return jnp.where(is_own, own, other)

    def _drawn_surface(
        self,
        key: jax.Array,
        surface: _Surface,
        same: jax.Array,
        unknown: tuple[jax.Array, jax.Array, jax.Array],
    ) -> jax.Array:
        """Pixels (H, W) drawn that show a surface, each with probability (H, W), or what is unknown."""
        keys = jax.random.split(key, 9)
        kappa, weights, _ = unknown
        shape = kappa.shape
        chance = [jax.random.uniform(one, shape) for one in keys[:5]]
        thing, behind = (self.image.unknown.drawn(one, weights) for one in keys[5:7])
        towards = surface.finite_m + self._sigma_m(surface) * jax.random.normal(keys[7], shape)
        is_thing = chance[0] < kappa
        anywhere = self.noise.max_range_m * chance[1]
        told = drawn_normal(keys[8], *map(jnp.stack, self._parts(surface, same)))
        seen = jnp.where(chance[2] < OUTLIERS, anywhere, told)
        seen = jnp.where(chance[3] < self._missing(surface, same), behind, seen)
        hit = jnp.where(is_thing & (thing < towards), thing, seen)
        miss = jnp.where(is_thing, thing, anywhere)
        none_hit, none_miss = self.noise.none_hit_probability, self.noise.none_miss_probability
        none = jnp.where(surface.there | is_thing, none_hit, none_miss)
        return jnp.where(chance[4] < none, NO_RETURN, jnp.where(surface.there, hit, miss))

    def _surface_of(self, pixels: ObjectPixels) -> _Surface:
        """What they show of the object, or what is beside it of those that it ends at."""
        return _Surface(pixels.wide_m, jnp.where(pixels.touches, self.shape_sigma_m, 0.0))

    def _rest(self) -> _Surface:
        """The supports."""
        rest_m = self.image.rest_m
        return _Surface(rest_m, SUPPORT_ERROR * jnp.where(jnp.isfinite(rest_m), rest_m, 0.0))

    def _share(self, pixels: ObjectPixels, mine: jax.Array) -> jax.Array:
        """Probability (H, W) of the object's side, which pixels show with probability (H, W)."""
        within = 1 - self._shifted(pixels.inner, 1 - mine)
        return jnp.where(pixels.covers, within, self._shifted(pixels.touches & ~pixels.covers, mine))

    def shown_by(self, layer_m: jax.Array) -> jax.Array:
        """Probability (H, W) that a pixel shows an object's layer (H, W), by its own depth; 0 beside it.

        Where nothing was measured, and at its outline, which cameras shift, it is as likely as not.
        """
        covers = jnp.isfinite(layer_m)
        surface = _Surface(layer_m, jnp.where(covers, self.shape_sigma_m, 0.0))
        shows = jnp.where(self.image.observed_m == NO_RETURN, UNKNOWN, self._shows(surface))
        return jnp.where(covers, shows * jnp.where(_all_beside(covers), 1.0, 0.5), 0.0)

    def _shifted(self, outline: jax.Array, other: jax.Array) -> jax.Array:
        """Probability (H, W) that pixels at one side of an outline show its other side; 0 elsewhere.

        An outline is shifted with probability 1/2, as it was one pixel before but for `CHANGES`; where it is,
        `edge_reach` of its pixels show the other side, which tells of those before whether it is.

        Args:
            outline: (H, W) bool, these pixels.
            other: (H, W) probability that they show the other side, by their own measurement.
        """
        told = (outline & (self.image.observed_m != NO_RETURN)).astype(other.dtype)
        count, seen = (sum(_left_and_above(part)) for part in (told, told * other))
        unseen = 0.5 * (1 - self.edge_reach) / (1 - 0.5 * self.edge_reach)
        before = unseen + (1 - unseen) * seen / jnp.maximum(count, 1.0)
        shifted = jnp.where(count > 0, CHANGES + (1 - 2 * CHANGES) * before, 0.5)
        return jnp.where(outline, self.edge_reach * shifted, 0.0)

    def _sigma_m(self, surface: _Surface) -> jax.Array:
        """Standard deviation (H, W) of a measurement of the surface."""
        return jnp.hypot(standard_deviation(self.noise, surface.finite_m), surface.sigma_m)

    def _shows(self, surface: _Surface) -> jax.Array:
        """Probability (H, W) that a pixel shows a surface and nothing unknown, by its own measurement."""
        there = surface.there & (self.image.observed_m != NO_RETURN)
        mine = normal_density(self.image.observed_m, surface.finite_m, self._sigma_m(surface))
        return jnp.where(there, mine / (mine + 1 / self.learned.reach_m), 0.0)

    def _shown(self, surface: _Surface, same: jax.Array) -> _Shown:
        """What pixels show of a surface, which each shows with probability (H, W)."""
        depth_m, sigma_m = surface.finite_m, self._sigma_m(surface)
        unknown = self.image.unknown
        before = [*unknown.parts_before(depth_m, sigma_m), unknown.new_before(depth_m, sigma_m)]
        return _Shown(
            there=surface.there,
            scene=self._scene(surface, same),
            missing=self._missing(surface, same),
            in_front=normal_distribution((depth_m - self.image.observed_m) / sigma_m),
            before=jnp.stack(before),
        )

    def _unknown(self, scene: jax.Array, objects: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Probability kappa of something unknown, weights (5, H, W) of what it may be, and its density u.

        Args:
            scene: (H, W) probability that a pixel shows anything of the scene.
            objects: (H, W) that it shows an object.
        """
        kept = kept_parts(*_left_and_above(objects), shifted(objects, 1, -1))
        weights = jnp.concatenate([kept, 1 - jnp.sum(kept * self.image.shares, axis=0, keepdims=True)])
        return self._kappa(scene), weights, jnp.sum(weights * self.image.parts, axis=0)

    def _density(self, shown: _Shown, unknown: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        """Density (H, W) of pixels that show a surface, or nothing where there is none."""
        none_hit, none_miss = self.noise.none_hit_probability, self.noise.none_miss_probability
        kappa, weights, u = unknown
        nearer = kappa * jnp.sum(weights * shown.before, axis=0)
        a = (1 - shown.missing) * shown.scene + shown.missing * u
        hit = (1 - none_hit) * ((1 - nearer) * a + kappa * u * shown.in_front)
        miss = (1 - kappa) * (1 - none_miss) * self._uniform() + kappa * (1 - none_hit) * u
        none = jnp.where(shown.there, none_hit, (1 - kappa) * none_miss + kappa * none_hit)
        measured = jnp.where(shown.there, hit, miss)
        return jnp.maximum(jnp.where(self.image.observed_m == NO_RETURN, none, measured), LEAST_DENSITY)

    def _scene(self, surface: _Surface, same: jax.Array) -> jax.Array:
        """The scene's part a (H, W), where pixels show this surface with probabilities (H, W)."""
        mixed = jnp.zeros_like(surface.depth_m)
        for weight, mean_m, spread_m in zip(*self._parts(surface, same), strict=True):
            mixed += weight * normal_density(self.image.observed_m, mean_m, spread_m)
        return OUTLIERS * self._uniform() + (1 - OUTLIERS) * mixed

    def _parts(
        self, surface: _Surface, same: jax.Array
    ) -> tuple[list[jax.Array], list[jax.Array], list[jax.Array]]:
        """Weights, means and deviations (H, W) of what foretells the measurements of a surface."""
        depth_m, sigma_m = surface.finite_m, self._sigma_m(surface)
        residual_m = _computed(jnp.where(surface.there, self.image.observed_m - depth_m, 0.0))
        residuals_m, shown = shifts(residual_m), shifts(same)
        beside = (0, 1), (1, 0), (1, 1), (1, -1)
        (left_m, above_m, corner_m, _), (left, above, corner, right) = (
            [before(*by) for by in beside] for before in (residuals_m, shown)
        )
        plane_m, _, _ = fitted(lambda *by: (residuals_m(*by), shown(*by)))
        sensor_m = standard_deviation(self.noise, depth_m)
        after = surprised(same * (residual_m - plane_m), sensor_m)[None]
        calm, astir = (self.learned.weights[kind, :, None, None] for kind in (NO_EDGE, NO_EDGE + EDGES))
        by_plane, by_above_plane, by_left, by_above, wide, by_right_plane, by_three, _ = jnp.where(
            after, astir, calm
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
        spreads_m = [self.learned.scales[scale] * sensor_m for _, _, scale, _ in parts]
        told = sum(weights, start=jnp.zeros_like(depth_m))
        return [*weights, 1 - told], [*means_m, depth_m], [*spreads_m, sigma_m]

    def _missing(self, surface: _Surface, same: jax.Array) -> jax.Array:
        """Probability (H, W) that a surface is not where it should be: what is behind it is seen there.

        Shapes, calibration and outlines are wrong in pieces.
        """
        behind = surface.there & (self.image.observed_m > surface.finite_m)
        left, above = _left_and_above(jnp.where(behind, 1 - same, 0.0))
        return MISSING + (MISSING_ON - MISSING) * (left + above) / 2

    def _kappa(self, shows: jax.Array) -> jax.Array:
        """Probability (H, W) of something unknown, by what the pixels before show of the scene (H, W).

        Outlines go on as they came: where the pixel to the left shows what the one above it does, this one
        shows what the one above does, and the same with rows and columns changed. A thing begins where all
        three show the scene with probability `CHANGES` along the row times the same along the column.
        """
        measured = self.image.observed_m != NO_RETURN
        (left, above), (known_left, known_above) = _left_and_above(shows), _left_and_above(measured)
        corner, known_corner = (_left_and_above(_left_and_above(part)[1])[0] for part in (shows, measured))
        count = known_left.astype(shows.dtype) + known_above
        mean = (known_left * left + known_above * above) / jnp.maximum(count, 1.0)
        goes_on = known_left & known_above & known_corner
        known = jnp.where(goes_on, jnp.clip(left + above - corner, 0.0, 1.0), mean)
        begins = jnp.where(goes_on, CHANGES ** (1 + left * above * corner), CHANGES)
        return jnp.where(count > 0, begins + (1 - begins - CHANGES) * (1 - known), UNKNOWN)

    def _uniform(self) -> jax.Array:
        range_m = self.noise.max_range_m
        return ((self.image.observed_m >= 0) & (self.image.observed_m <= range_m)) / range_m


_of_image = jax.jit(PixelDensity.of_image, compiler_options=FAST_COMPILE)


def _left_and_above(image: jax.Array) -> tuple[jax.Array, jax.Array]:
    """For every pixel the value of that to the left and of that above, 0 beyond the border."""
    return jnp.pad(image, ((0, 0), (1, 0)))[:, :-1], jnp.pad(image, ((1, 0), (0, 0)))[:-1]


def _nearest_beside(layer_m: jax.Array) -> jax.Array:
    """The least depth (H, W) of the four pixels beside each."""
    wide = jnp.pad(layer_m, 1, constant_values=jnp.inf)
    beside = wide[:-2, 1:-1], wide[2:, 1:-1], wide[1:-1, :-2], wide[1:-1, 2:]
    return jnp.min(jnp.stack(beside), axis=0)


def _all_beside(mask: jax.Array) -> jax.Array:
    """Whether a mask (H, W) holds the four pixels beside each; what is beyond the border counts as held."""
    wide = jnp.pad(mask, 1, constant_values=True)
    return wide[:-2, 1:-1] & wide[2:, 1:-1] & wide[1:-1, :-2] & wide[1:-1, 2:]


def _computed(images: Images) -> Images:
    """The images, computed before they are used: what looks at neighbours would compute them for each."""
    return jax.lax.optimization_barrier(images)
