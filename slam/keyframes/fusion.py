"""Fusing a tracked frame into a keyframe's depth: a Kalman update per surface element."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie

from recordings.types import NO_RETURN, DepthNoise
from shapes import depth_noise
from shapes.geometry.poses import transformed
from shapes.geometry.vectors import dot, rotate
from slam.keyframes.depth_view import CanvasView
from slam.keyframes.rendering import depth_on_rays, pixels_of, planes_in_frame
from slam.keyframes.surfels import LEAST_VARIANCE_SHARE, SurfelImage

GATE_SIGMAS = 3.0
"""The usual three-sigma gate of a Kalman update."""

GAIN_RANGE = (0.2, 5.0)
"""Limits of the ratio between a depth change along the keyframe's ray and along the frame's ray."""


def fuse(
    surface: SurfelImage, frame: CanvasView, keyframe_from_camera: jax.Array, noise: DepthNoise
) -> SurfelImage:
    """The surface after a frame seen from `keyframe_from_camera` (7,); planes keep their orientation.

    The frame's depth is compared with the element's plane on the frame's own ray; the difference moves
    the element along its plane's normal, weighed by inverse variances.
    """
    return surface.with_stored(_fused(surface, frame, keyframe_from_camera, noise))


@jax.jit
def _fused(
    surface: SurfelImage, frame: CanvasView, keyframe_from_camera: jax.Array, noise: DepthNoise
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Depths, planes and variances after the frame."""
    pose = jaxlie.SE3(keyframe_from_camera)
    depth, variance = surface.depth_m.ravel(), surface.variance_m2.ravel()
    planes = surface.planes.reshape(3, -1)
    points = transformed(pose.inverse().wxyz_xyz, surface.points().reshape(3, -1))
    pixel, inside = pixels_of(points, frame.camera)
    observed = frame.depth_m.ravel()[pixel]
    ray = frame.rays.reshape(3, -1)[:, pixel]
    rendered = depth_on_rays(planes_in_frame(planes, keyframe_from_camera), ray)
    observed_variance = depth_noise.standard_deviation(noise, observed) ** 2
    seen = inside & (depth > NO_RETURN) & (observed > NO_RETURN) & jnp.isfinite(rendered)
    innovation = jnp.where(seen, observed - rendered, 0.0)
    seen &= jnp.abs(innovation) < GATE_SIGMAS * jnp.sqrt(observed_variance + variance)
    along_keyframe_ray = dot(planes, surface.rays.reshape(3, -1))
    along_frame_ray = dot(rotate(pose.rotation().as_matrix().T, planes), ray)
    gain = jnp.clip(along_frame_ray / jnp.where(along_keyframe_ray > 0, along_keyframe_ray, 1.0), *GAIN_RANGE)
    carried_variance = observed_variance * gain**2
    share = jnp.where(seen, variance / (variance + carried_variance), 0.0)
    refined = depth + share * gain * innovation
    floor = LEAST_VARIANCE_SHARE * depth_noise.standard_deviation(noise, depth) ** 2
    scale = jnp.where(seen, depth / jnp.where(seen, refined, 1.0), 1.0)
    shape = surface.depth_m.shape
    variance = jnp.maximum((1.0 - share) * variance, jnp.minimum(floor, variance))
    return refined.reshape(shape), surface.planes * scale.reshape(shape)[None], variance.reshape(shape)
