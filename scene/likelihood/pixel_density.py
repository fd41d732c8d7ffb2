"""A density of a depth image given a scene: a product over pixels in raster order.

`scene.likelihood.pixel_factors` has the factors. What they need of the image and its supports is computed
once, for all scenes; what they need of an object's depth, in the whole image; the factors themselves only
where the object has a part in the image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN, DepthNoise
from scene.execution import FAST_COMPILE
from scene.likelihood.object_pixels import ObjectPixels, all_beside
from scene.likelihood.pixel_factors import (
    UNKNOWN,
    EarlierPixels,
    PixelFactors,
    Shown,
    Surface,
    SurfaceBefore,
    Unknown,
    calm_and_astir,
)
from scene.likelihood.pixel_places import ImageParts, Places
from scene.likelihood.unknown_surfaces import UnknownSurfaces, UnknownWeights
from shapes.depth_noise import standard_deviation
from shapes.stored_kernels import jit_stored

SUPPORT_ERROR = 0.01
"""Error of a support over its depth, which is a depth camera's scale and bend."""
EDGE_PX = 3.0
"""Pixels of an image by which cameras shift outlines."""
BEFORE = 4.0
"""Standard deviations by which noise puts one pixel of 30,000 before a surface."""
_ONLY = ImageParts(np.zeros(1, np.int32))
"""In which image layers are seen where there is but one."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ImageTerms:
    """What the density of every scene takes from an image and its supports; leaves (..., H, W).

    Attributes:
        observed_m: `NO_RETURN` where nothing was measured.
        rest_m: depth of the supports, +inf where none is.
        unknown: what else the pixels may show.
        parts: (L + 1, H, W) density at the observed depth of what is foretold of unknown things, L ways as
            `PREDICTIONS` has them, and of one that begins here.
        shares: (L, H, W) weights of what is foretold.
        behind: probability that a pixel shows the supports.
        rest: what pixels show of the supports.
        earlier_m: what an earlier frame has measured, `NO_RETURN` where nothing; None where there is none.
        earlier_behind: probability that it shows the supports; None likewise.
    """

    observed_m: jax.Array
    rest_m: jax.Array
    unknown: UnknownSurfaces
    parts: jax.Array
    shares: jax.Array
    behind: jax.Array
    rest: Shown
    earlier_m: jax.Array | None
    earlier_behind: jax.Array | None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SurfaceImages:
    """A surface in images, and what pixels show of it by their own measurement; leaves (N, H, W).

    Attributes:
        depth_m: +inf where it is not.
        sigma_m: its own error.
        shows: probability that a pixel shows it.
        residual_m: observed depth less its own, 0 where it is not.
        badly_foretold: whether that is far from what the pixels before foretell.
    """

    depth_m: jax.Array
    sigma_m: jax.Array
    shows: jax.Array
    residual_m: jax.Array
    badly_foretold: jax.Array

    def at(self, places: Places) -> tuple[Surface, SurfaceBefore]:
        """The surface (P,) at listed pixels, and what is beside them."""
        surprising = places.beside(self.badly_foretold)
        before = SurfaceBefore(
            shows=places.beside(self.shows),
            residual_m=places.beside(self.residual_m),
            surprised=surprising(0, 1) | surprising(1, 0),
        )
        return Surface(places.of(self.depth_m), places.of(self.sigma_m)), before


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ObjectImages:
    """Objects in images (N, H, W), each alone.

    Attributes:
        pixels: that they have a part in.
        surfaces: theirs, or beside them what they end at.
    """

    pixels: ObjectPixels
    surfaces: SurfaceImages

    def share(
        self, factors: PixelFactors, surface: Surface, before: SurfaceBefore, places: Places
    ) -> jax.Array:
        """Probability (P,) of the objects' side of their outlines at listed pixels."""
        inner, outer = places.beside(self.pixels.inner), places.beside(self.pixels.outer)
        earlier = factors.shows_earlier(surface)
        not_earlier = None if earlier is None else 1 - earlier
        within = 1 - factors.shifted(inner, lambda *by: 1 - before.shows(*by), not_earlier)
        beside = factors.shifted(outer, before.shows, earlier)
        return jnp.where(places.of(self.pixels.covers), within, beside)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PixelDensity:
    """The density of one image, ready for scenes; of F images with leaves (F, ...).

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
        earlier_m: NDArray[np.float32] | None = None,
    ) -> PixelDensity:
        """The density of every `stride`-th pixel (H, W) of an image.

        Args:
            depth_m: of these pixels.
            rest_m: (H, W) of the supports, +inf where none is.
            noise: of the sensor.
            shape_sigma_m: error of objects' surfaces.
            stride: pixels of the image from one of these to the next.
            learned: how well they foretell each other; None learns it from these pixels.
            earlier_m: (H, W) what an earlier frame has measured there, `NO_RETURN` where nothing; None where
                there is none.
        """
        learned = learned or UnknownWeights.learned([depth_m], noise)
        numbers = noise, shape_sigma_m, min(1.0, EDGE_PX / stride), learned
        with jax.enable_x64(False):
            return _of_image(depth_m, rest_m, *jax.tree.map(np.float32, numbers), earlier_m)

    @classmethod
    def of_image(
        cls,
        observed_m: jax.Array,
        rest_m: jax.Array,
        noise: DepthNoise,
        shape_sigma_m: jax.Array,
        edge_reach: jax.Array,
        learned: UnknownWeights,
        earlier_m: jax.Array | None = None,
    ) -> PixelDensity:
        """The density of an image (H, W) before supports (H, W) with all that is learned of its sensor.

        Given what an earlier frame has measured (H, W), if there is one.
        """
        unknown = UnknownSurfaces.of(observed_m, noise, learned, earlier_m)
        parts = [*unknown.density_parts(observed_m), unknown.new_density(observed_m)]
        blank = jnp.zeros_like(observed_m)
        nothing = Shown(blank, blank, blank, blank, [blank] * len(parts))
        foretold = jnp.stack(parts), jnp.stack(unknown.shares())
        terms = ImageTerms(observed_m, rest_m, unknown, *foretold, blank, nothing, earlier_m, None)
        density = cls(noise, shape_sigma_m, edge_reach, learned, terms, blank)
        one, everywhere = density.stacked(), Places.everywhere(blank.shape)
        supports = one.support_images()
        surface, before = supports.at(everywhere)
        factors = one.factors(everywhere)
        shown = factors.shown(surface, before)
        shows_earlier, no_object = factors.shows_earlier(surface), everywhere.beside(blank[None])
        seen = None if shows_earlier is None else (shows_earlier, no_object(0, 0))
        unknown = factors.unknown_beside(before.shows, no_object, seen)
        log_rest = jnp.log(factors.density(shown, unknown))
        behind, rest = jax.tree.map(
            lambda leaf: leaf.reshape(*leaf.shape[:-1], *blank.shape), (before.shows(0, 0), shown)
        )
        earlier_behind = None if shows_earlier is None else shows_earlier.reshape(blank.shape)
        terms = replace(terms, behind=behind, rest=rest, earlier_behind=earlier_behind)
        return replace(density, image=terms, log_rest=log_rest.reshape(blank.shape))

    def stacked(self) -> PixelDensity:
        """That of one image as that of F = 1 images."""
        return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], self)

    def drawn(self, key: jax.Array, pixels: ObjectPixels, places: Places) -> jax.Array:
        """Listed pixels (P,) drawn given those before them, cause by cause: the law whose density this is.

        Args:
            key: random key.
            pixels: (1, H, W) of the object that they have a part in.
            places: in the one image.
        """
        side_key, own_key, other_key = jax.random.split(key, 3)
        one = self.stacked()
        objects = one.object_images(pixels, _ONLY)
        own, own_before = one.with_badly_foretold(objects.surfaces).at(places)
        other, other_before = one.support_images().at(places)
        factors = one.factors(places)
        unknown = one._unknown_at(factors, own, own_before, places)
        own_m = factors.drawn(own_key, own, own_before, unknown)
        other_m = factors.drawn(other_key, other, other_before, unknown)
        is_own = jax.random.uniform(side_key, own_m.shape) < objects.share(factors, own, own_before, places)
        return jnp.where(is_own, own_m, other_m)

    def object_images(self, pixels: ObjectPixels, parts: ImageParts) -> ObjectImages:
        """Objects in parts of images; what is badly foretold is left open.

        Args:
            pixels: (n, h, w) of objects, each alone.
            parts: (n,) of the F images, in which each is seen.
        """
        sigma_m = jnp.where(jnp.isfinite(pixels.wide_m), parts.of_images(self.shape_sigma_m), 0.0)
        return ObjectImages(pixels, self._surface_images(pixels.wide_m, sigma_m, parts))

    def support_images(self) -> SurfaceImages:
        """The supports in the one image."""
        rest_m = self.image.rest_m
        sigma_m = SUPPORT_ERROR * jnp.where(jnp.isfinite(rest_m), rest_m, 0.0)
        return self.with_badly_foretold(self._surface_images(rest_m, sigma_m, _ONLY))

    def with_badly_foretold(self, surfaces: SurfaceImages) -> SurfaceImages:
        """Surfaces (1, H, W) in the one image, with what is badly foretold."""
        everywhere = Places.everywhere(surfaces.depth_m.shape[1:])
        badly = self.badly_foretold(surfaces, _ONLY, everywhere).reshape(surfaces.depth_m.shape)
        return replace(surfaces, badly_foretold=badly)

    def badly_foretold(self, surfaces: SurfaceImages, parts: ImageParts, places: Places) -> jax.Array:
        """Whether what listed pixels (P,) show of surfaces (n, h, w) is far from what is foretold.

        Args:
            surfaces: each in a part of one of the F images.
            parts: (n,) these.
            places: in the n.
        """
        surface, before = surfaces.at(places)
        return before.badly_foretold(surface, jax.tree.map(parts.in_images(places).of_images, self.noise))

    def log_factors(self, objects: ObjectImages, parts: ImageParts, places: Places) -> jax.Array:
        """Log density (P,) of listed pixels of objects (n, h, w), each alone in a part (n,) of the images.

        A camera shifts outlines: at one a pixel may show the other side of it, and most so beside others that
        do. Where the object ends no unknown surface goes on from it, which pixels beside it tell.
        """
        in_frames = parts.in_images(places)
        factors = self.factors(in_frames)
        surface, before = objects.surfaces.at(places)
        unknown = self._unknown_at(factors, surface, before, in_frames)
        share = objects.share(factors, surface, before, places)
        own = factors.density(factors.shown(surface, before), unknown)
        other = factors.density(jax.tree.map(in_frames.of, self.image.rest), unknown)
        return jnp.log(share * own + (1 - share) * other)

    def _unknown_at(
        self, factors: PixelFactors, surface: Surface, before: SurfaceBefore, places: Places
    ) -> Unknown:
        """What listed pixels (P,) of the F images may show beside an object and the supports."""
        behind, seen = places.beside(self.image.behind), None
        shows_earlier = factors.shows_earlier(surface)
        if self.image.earlier_behind is not None and shows_earlier is not None:
            scene = jnp.maximum(shows_earlier, places.of(self.image.earlier_behind))
            seen = scene, shows_earlier
        return factors.unknown_beside(
            lambda *by: jnp.maximum(before.shows(*by), behind(*by)), before.shows, seen
        )

    def shown_by(self, layer_m: jax.Array) -> jax.Array:
        """Probability (H, W) that a pixel shows an object's layer (H, W), by its own depth; 0 beside it.

        Where nothing was measured, and at its outline, which cameras shift, it is as likely as not.
        """
        covers = jnp.isfinite(layer_m)
        surface = Surface(layer_m, jnp.where(covers, self.shape_sigma_m, 0.0))
        observed_m = self.image.observed_m
        shows = surface.shows(observed_m, self.noise, self.learned.reach_m)
        shows = jnp.where(observed_m == NO_RETURN, UNKNOWN, shows)
        return jnp.where(covers, shows * jnp.where(all_beside(covers), 1.0, 0.5), 0.0)

    def measured_before(self, layers_m: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Where (n, H, W) something is measured `BEFORE` standard deviations before layers (n, H, W)."""
        observed_m, covers = np.asarray(self.image.observed_m), np.isfinite(layers_m)
        there_m = np.where(covers, layers_m, 0.0)
        sigma_m = np.hypot(standard_deviation(jax.device_get(self.noise), there_m), self.shape_sigma_m)
        return covers & (observed_m != NO_RETURN) & (observed_m < there_m - BEFORE * sigma_m)

    def factors(self, places: Places) -> PixelFactors:
        """The factors of listed pixels (P,) of the F images."""
        sensor = self.noise, self.edge_reach, calm_and_astir(self.learned.weights), self.learned.scales
        noise, edge_reach, weights, scales = jax.tree.map(places.of_images, sensor)
        image, observed_m, unknown = self.image, places.beside(self.image.observed_m), self.image.unknown
        means_m, sigmas_m, shares, columns = (
            places.of(part) for part in (unknown.means_m, unknown.sigmas_m, unknown.weights, unknown.columns)
        )
        return PixelFactors(
            noise=noise,
            edge_reach=edge_reach,
            weights=weights,
            scales=scales,
            observed_m=observed_m(0, 0),
            unknown=UnknownSurfaces(
                means_m, sigmas_m, shares, columns, places.of_images(self.learned.reach_m)
            ),
            parts=places.of(image.parts),
            shares=places.of(image.shares),
            measured=lambda *by: observed_m(*by) != NO_RETURN,
            earlier=self._earlier_at(places),
        )

    def _earlier_at(self, places: Places) -> EarlierPixels | None:
        """What an earlier frame has measured at listed pixels (P,)."""
        earlier_m, learned = self.image.earlier_m, self.learned.earlier
        if earlier_m is None or learned is None:
            return None
        weights, scales = (places.of_images(part) for part in (learned.weights, learned.scales))
        return EarlierPixels(places.of(earlier_m), weights, scales)

    def _surface_images(self, depth_m: jax.Array, sigma_m: jax.Array, parts: ImageParts) -> SurfaceImages:
        """Surfaces (n, h, w) with errors likewise in parts (n,); what is badly foretold is left open."""
        surface, observed_m = Surface(depth_m, sigma_m), parts.of(self.image.observed_m, depth_m.shape[1:])
        noise, reach_m = jax.tree.map(parts.of_images, (self.noise, self.learned.reach_m))
        shows, residual_m = surface.shows(observed_m, noise, reach_m), surface.residual_m(observed_m)
        nowhere = jnp.zeros(depth_m.shape, bool)
        return SurfaceImages(depth_m, sigma_m, shows, residual_m, nowhere)


_of_image = jit_stored(compiler_options=FAST_COMPILE)(PixelDensity.of_image)
