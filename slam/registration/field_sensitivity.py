"""How a frame's optimum follows the sensor's distortion field, to first order.

Frame and map are measured by the same sensor. Where a pixel of the frame falls on another part of the image
than it did in the keyframe, their depths err differently, and the frame's pose with them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from recordings.types import DepthNoise
from shapes.geometry.pose_sets import IDENTITY
from shapes.geometry.poses import transformed
from shapes.geometry.vectors import dot
from shapes.stored_kernels import jit_stored
from slam.keyframes.depth_view import CanvasView
from slam.keyframes.rendering import LEAST_INVERSE_DEPTH, MapImage, depth_from, fused_planes, pixels_of
from slam.likelihood.distortion import NodeWeights
from slam.likelihood.image_density import STRIDE_PX, ScoredPixels
from slam.registration.alignment import pixel_terms
from slam.registration.local_map import LocalMap
from slam.registration.local_search import Optimum


@jit_stored()
def field_sensitivity(
    optimum: Optimum,
    local_map: LocalMap,
    view: CanvasView,
    nodes: NodeWeights,
    noise: DepthNoise,
    tempered_covariance: jax.Array,
) -> jax.Array:
    """Displacement (6, NODES) of a frame in its own chart for a unit of each node, keyframes staying.

    Args:
        optimum: of the frame.
        local_map: that it was compared with.
        view: the frame.
        nodes: on its canvas, and on those of the keyframes.
        noise: the sensor.
        tempered_covariance: (6, 6) of the pose, times the exponent of the image density.
    """
    pixels = optimum.pixels
    keyframes_from_camera = local_map.keyframes_from_camera(optimum.pose)
    image = MapImage(pixels.planes, pixels.weights)
    planes, variance = fused_planes(image, keyframes_from_camera)
    identity = jnp.asarray(IDENTITY, optimum.pose.dtype)
    terms = pixel_terms(planes, variance, pixels.observed_m, pixels.rays, identity, noise)
    of_residual = (pixels.observed_m**2)[None] * nodes.at(_lattice(view)) - sum(
        _of_rendered(index, pixels, local_map, keyframes_from_camera[index], nodes)
        for index in range(len(local_map.present))
    )
    return tempered_covariance @ ((terms.jacobian * terms.weight[None]) @ of_residual.T)


def _lattice(view: CanvasView) -> jax.Array:
    """Flat indices (P,) of the pixels that the image density counts."""
    rows, columns = view.depth_m.shape
    return jnp.arange(rows * columns).reshape(rows, columns)[::STRIDE_PX, ::STRIDE_PX].ravel()


def _of_rendered(
    index: int, pixels: ScoredPixels, local_map: LocalMap, keyframe_from_camera: jax.Array, nodes: NodeWeights
) -> jax.Array:
    """Derivative (NODES, P) of the rendered depth through the elements of one keyframe."""
    planes = pixels.planes[index]
    depth, slope, ahead = depth_from(keyframe_from_camera, planes, pixels.rays)
    surfaces = local_map.surfaces
    camera = jax.tree.map(lambda leaf: leaf[index], surfaces.camera)
    pixel, inside = pixels_of(transformed(keyframe_from_camera, pixels.rays * depth[None]), camera)
    inverse_depth = dot(planes, surfaces.rays[index].reshape(3, -1)[:, pixel])
    meets = ahead & inside & (inverse_depth > LEAST_INVERSE_DEPTH)
    total = jnp.maximum(pixels.weights.sum(0), 1e-12)
    gain = jnp.where(meets, 1.0 / jnp.where(meets, inverse_depth * slope, 1.0), 0.0)
    return (gain * pixels.weights[index] / total)[None] * nodes.at(pixel)
