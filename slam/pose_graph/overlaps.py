"""Keyframes at full detail, and the pairs of them that overlap."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from recordings.types import NO_RETURN, DepthNoise
from shapes.geometry.poses import matrices_of, relative_pose
from slam.filter.state import FilterState
from slam.keyframes.covisibility import held_together
from slam.keyframes.depth_view import CanvasView, framing
from slam.keyframes.keyframe_map import KeyframeMap, selected_keyframes
from slam.keyframes.pages import Paged
from slam.keyframes.plane_segmentation import with_plane_segments
from slam.keyframes.planes import region_planes
from slam.likelihood.distortion import NodeWeights
from slam.likelihood.overlap_density import (
    PlaneImage,
    PointSample,
    log_overlap_densities,
    points_at,
    sampled_pixels,
)

OVERLAPS = 6
"""Earlier keyframes with which each one is compared, both ways round."""

IMAGE_BUCKET = 4
"""Images compared with one surface in one call, so that kernels are compiled once."""


@dataclass(frozen=True)
class KeyframeDetail:
    """A keyframe at full detail: its view, and `region_planes` of it.

    JAX computes in the background: planes are asked for long before a map is refined.
    `is_segmented` says whether large planes are one each; `known_pixels` are `pixels` where these are known.
    """

    ARRAYS: ClassVar[int] = 4
    ROOM: ClassVar[int] = 24
    """100 MB in memory, with what is derived: a keyframe overlaps with a dozen, most of them neighbours."""

    view: CanvasView
    planes: jax.Array
    region_sizes: jax.Array
    is_segmented: bool = False
    known_pixels: NDArray[np.int32] | None = None

    @cached_property
    def surface(self) -> PlaneImage:
        """With planes where regions have one."""
        return PlaneImage.of(self.view, jnp.where((self.region_sizes > 0)[None], self.planes, 0.0))

    @cached_property
    def pixels(self) -> NDArray[np.int32]:
        """Flat indices of those that are compared."""
        known = self.known_pixels
        return sampled_pixels(np.asarray(self.region_sizes)) if known is None else known

    @cached_property
    def sample(self) -> PointSample:
        """What lies there."""
        return points_at(self.view, self.planes, self.pixels)

    def stored(self) -> Sequence[ArrayLike]:
        """What no other keyframe has as well; sizes are products of three counts up to 25."""
        return self.view.depth_m, self.planes, np.asarray(self.region_sizes, np.uint16), self.pixels

    def with_stored(self, arrays: Sequence[Any]) -> KeyframeDetail:
        """With those arrays, or without any."""
        *images, pixels = arrays
        on_device: list[Any] = [one if one is None else jnp.asarray(one, jnp.float32) for one in images]
        depth_m, planes, region_sizes = on_device
        view = replace(self.view, depth_m=depth_m)
        return KeyframeDetail(view, planes, region_sizes, self.is_segmented, pixels)

    def with_plane_segments(self, noise: DepthNoise) -> KeyframeDetail:
        """The same with large planes as one each."""
        planes = with_plane_segments(np.asarray(self.planes), np.asarray(self.region_sizes), self.view, noise)
        return replace(self, planes=jnp.asarray(planes), is_segmented=True)

    def without_distortion(self, disparity_per_m: jax.Array, noise: DepthNoise) -> KeyframeDetail:
        """The same as a sensor without the distortion field of these nodes (NODES,) would have seen it."""
        depth = self.view.depth_m
        shrink = 1.0 - NodeWeights.of(self.view).field(disparity_per_m) * depth
        corrected = jnp.where((depth != NO_RETURN) & (shrink > 0), depth / shrink, NO_RETURN)
        detail = keyframe_detail(replace(self.view, depth_m=corrected), noise)
        return detail.with_plane_segments(noise) if self.is_segmented else detail


def keyframe_detail(view: CanvasView, noise: DepthNoise) -> KeyframeDetail:
    """A keyframe seen on `FINE_CANVAS`."""
    return KeyframeDetail(view, *region_planes(view, noise))


@dataclass(frozen=True, kw_only=True)
class Keyframes:
    """Keyframes at full detail, and which of them overlap.

    Attributes:
        details: N.
        images_of: for each one as a surface, the keyframes (n,) whose images are compared with it.
        noise: the sensor, at full detail.
        fixed: so many, the first ones, stay where they are; they are not compared with each other.
    """

    details: Sequence[Paged[KeyframeDetail]]
    images_of: Sequence[NDArray[np.int_]]
    noise: DepthNoise
    fixed: int = 1

    def first(self, count: int) -> Keyframes:
        """The first so many, and their overlaps with each other."""
        images_of = [images[images < count] for images in self.images_of[:count]]
        return replace(self, details=self.details[:count], images_of=images_of)

    def corrected(self, disparity_per_m: jax.Array) -> Keyframes:
        """The same without the distortion field of these nodes (NODES,) in their images."""
        details = [
            detail.pages.hold(detail.value.without_distortion(disparity_per_m, self.noise))
            for detail in self.details
        ]
        return replace(self, details=details)

    def batches(self, stride: int) -> Iterator[tuple[PlaneImage, PointSample, int, NDArray[np.int_]]]:
        """Surface, every `stride`-th sample of the images, the surface's index, the images' (n,)."""
        for surface, images in enumerate(self.images_of):
            for first in range(0, len(images), IMAGE_BUCKET):
                chosen = images[first : first + IMAGE_BUCKET]
                padded = [self.details[int(image)].value.sample for image in np.resize(chosen, IMAGE_BUCKET)]
                samples = jax.tree.map(
                    lambda *leaves: np.stack([leaf[:, ::stride] for leaf in leaves]), *padded
                )
                yield self.details[surface].value.surface, samples, surface, chosen

    def log_densities(
        self, poses: NDArray[np.float32], exponents: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Log densities (L,) of all overlaps at keyframes (L, N, 7), each image's to its exponent (N,)."""
        total = np.zeros(len(poses))
        for surface, samples, index, images in self.batches(1):
            padded = np.resize(images, IMAGE_BUCKET)
            relative = _relative_by_image(poses[:, index], poses[:, padded])
            densities = log_overlap_densities(surface, samples, relative, self.noise)
            total += exponents[images] @ np.asarray(densities, np.float64)[: len(images)]
        return total


@dataclass(frozen=True, kw_only=True)
class KeyframeImages:
    """Keyframes whose poses are sought.

    Attributes:
        keyframe_map: at working resolution.
        details: of each keyframe.
        noise: the sensor at that detail.
        known: (E, 2) pairs that are known to see the same; only what they hold together is compared. With
            None all that are in sight are.
        first_new: keyframe from which on none has been compared with places that it may have come back to.
    """

    keyframe_map: KeyframeMap
    details: Sequence[Paged[KeyframeDetail]]
    noise: DepthNoise
    known: NDArray[np.int32] | None = None
    first_new: int = 1

    @classmethod
    def of(
        cls, state: FilterState, details: Sequence[Paged[KeyframeDetail]], noise: DepthNoise
    ) -> KeyframeImages:
        """Those of the filter's map. The sensor reaches as far as the filter has seen it reach."""
        return cls(
            keyframe_map=state.keyframe_map,
            details=details,
            noise=replace(noise, max_range_m=state.calibration.noise.max_range_m),
            first_new=state.refined_keyframes,
        )

    def with_known(self, pairs: NDArray[np.integer]) -> KeyframeImages:
        """The same with more pairs (n, 2) that are known to see the same."""
        if self.known is None:
            return self
        return replace(self, known=np.unique(np.concatenate([self.known, pairs]), axis=0).astype(np.int32))

    def at(self, poses: NDArray[np.float32], fixed: int = 1) -> Keyframes:
        """With the overlaps that they have at poses (N, 7), of which the first ones are fixed."""
        return self.placed(matrices_of(poses), fixed)

    def placed(self, poses: NDArray[np.float64], fixed: int = 1) -> Keyframes:
        """The same at poses (N, 4, 4)."""
        details, samples = self.details, self.keyframe_map.samples
        together = None if self.known is None else held_together(len(details), self.known)
        overlaps: list[set[int]] = [set() for _ in details]
        for second in range(fixed, len(details)):
            candidates = np.arange(second)
            if together is not None:
                candidates = candidates[together[[second], :second].toarray()[0]]
            if not len(candidates):
                continue
            others, frame = [samples[one] for one in candidates], framing(details[second].skeleton.view)
            placed = poses[candidates], samples[second], poses[second]
            chosen = selected_keyframes(others, *placed, frame, OVERLAPS)
            for first in candidates[chosen].tolist():
                overlaps[first].add(second)
                overlaps[second].add(first)
        images_of = [np.asarray(sorted(images), int) for images in overlaps]
        return Keyframes(details=details, images_of=images_of, noise=self.noise, fixed=fixed)


@jax.jit
def _relative_by_image(origins: jax.Array, poses: jax.Array) -> jax.Array:
    """origin_from_pose (n, L, 7) of L poses (L, 7) and of n others each (L, n, 7)."""
    return jax.vmap(relative_to)(origins, poses).swapaxes(0, 1)


relative_to = jax.jit(jax.vmap(relative_pose, (None, 0)))
"""origin_from_pose (n, 7) of one pose (7,) and others (n, 7)."""
