"""Keyframe surfaces: what one view contributes to the map, and how later frames refine it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from recordings.types import DepthNoise
from shapes import depth_noise
from shapes.geometry.camera import Camera
from slam.keyframes.depth_view import CanvasView
from slam.keyframes.planes import region_planes

LEAST_VARIANCE_SHARE = 0.1
"""Of a pixel's variance: planes of flat regions are known better (2 to 4% on walls, 27% by creases;
docs/model.md, development films), but errors that views share (calibration, distortion) do not average
out."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SurfelImage:
    """One surface element per pixel of a keyframe, in its own camera frame; shared by all hypotheses.

    Attributes:
        depth_m: (H, W) float32, `NO_RETURN` where unknown.
        planes: (3, H, W) plane vectors N through those points: N . P = 1.
        variance_m2: (H, W) variance of the depth.
        measured: (H, W) bool, the pixels that the image has.
        rays: (3, H, W) through the pixel centres, z = 1.
        camera: intrinsics at working resolution.
    """

    ARRAYS: ClassVar[int] = 3
    ROOM: ClassVar[int] = 96
    """40 MB in memory; a frame is compared with a few, a lost one with 40."""

    depth_m: jax.Array
    planes: jax.Array
    variance_m2: jax.Array
    measured: jax.Array
    rays: jax.Array
    camera: Camera

    @property
    def view(self) -> CanvasView:
        """As an image."""
        return CanvasView(self.depth_m, self.measured, self.rays, self.camera)

    def points(self) -> jax.Array:
        """(3, H, W) in the keyframe's frame; the origin where unknown."""
        return self.rays * self.depth_m[None]

    def stored(self) -> Sequence[jax.Array]:
        """What no other keyframe has as well."""
        return self.depth_m, self.planes, self.variance_m2

    def with_stored(self, arrays: Sequence[Any]) -> SurfelImage:
        """With those arrays, or without any."""
        depth_m, planes, variance_m2 = arrays
        return replace(self, depth_m=depth_m, planes=planes, variance_m2=variance_m2).committed()

    def committed(self) -> SurfelImage:
        """The same, its arrays bound to the device.

        Kernels from the store give bound arrays, others free ones, and JAX compiles a kernel anew for every
        mixture of them among its arguments.
        """
        arrays = jax.device_put(self.stored(), jax.devices()[0])
        return replace(self, **dict(zip(("depth_m", "planes", "variance_m2"), arrays, strict=True)))


def surfel_image(view: CanvasView, noise: DepthNoise) -> SurfelImage:
    """The surface that a single view shows."""
    planes, region_sizes = region_planes(view, noise)
    share = jnp.where(region_sizes > 1.0, LEAST_VARIANCE_SHARE, 1.0)
    variance = share * depth_noise.standard_deviation(noise, view.depth_m) ** 2
    return SurfelImage(view.depth_m, planes, variance, view.measured, view.rays, view.camera)


def with_noise(surface: SurfelImage, believed: DepthNoise, learnt: DepthNoise) -> SurfelImage:
    """The surface with variances as if it had been measured by the sensor that is now known."""
    scaled = _scaled_variance(surface.variance_m2, surface.depth_m, believed, learnt)
    return replace(surface, variance_m2=scaled)


@jax.jit
def _scaled_variance(
    variance_m2: jax.Array, depth_m: jax.Array, believed: DepthNoise, learnt: DepthNoise
) -> jax.Array:
    ratio = depth_noise.standard_deviation(learnt, depth_m) / depth_noise.standard_deviation(
        believed, depth_m
    )
    return variance_m2 * ratio**2
