"""Segmentation of walls, floors and table tops: one plane over all of an image that it covers.

Planes of small windows (`slam.keyframes.planes`) rotate by degrees from pixel to pixel of a far wall. Where
all that two views share is one wall, these rotations look like information on motion along it, a centimetre's
worth, all of it wrong.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN, DepthNoise
from shapes import depth_noise
from slam.keyframes.depth_view import CanvasView
from slam.keyframes.planes import LEAST_REGION, ON_PLANE_SIGMAS

LEAST_SHARE = 0.03
"""Of an image's pixels, from which on a plane is one."""

MOST_TURN_RAD = 0.3
"""Between the normals of a pixel and of the plane that it is to belong to."""

MOST_SEEDS, GROWTH_ROUNDS = 16, 8
"""Search effort: planes tried and rounds of growth."""


def with_plane_segments(
    planes: NDArray[np.float32], region_sizes: NDArray[np.float32], view: CanvasView, noise: DepthNoise
) -> NDArray[np.float32]:
    """Planes (3, H, W) with one for all pixels of each large plane; pixels without stay so.

    Planes are grown from the flattest pixel that belongs to none: all pixels within the noise are fitted by
    least squares of inverse depth, 1/z = N . d, again and again.

    Args:
        planes: of `slam.keyframes.planes.region_planes`.
        region_sizes: (H, W) from the same.
        view: that they were fitted in.
        noise: the sensor.
    """
    depth, rays = np.asarray(view.depth_m, np.float64), np.asarray(view.rays, np.float64)
    inverse = np.where(depth > NO_RETURN, 1.0 / np.where(depth > NO_RETURN, depth, 1.0), 0.0)
    sigma = (
        np.asarray(depth_noise.standard_deviation(noise, jnp.asarray(view.depth_m)), np.float64) * inverse**2
    )
    normals = planes / np.maximum(np.linalg.norm(planes, axis=0), 1e-12)
    free, result = region_sizes > 0, planes.copy()
    flattest = np.argsort(-region_sizes.ravel(), kind="stable")
    for _ in range(MOST_SEEDS):
        seed = next((at for at in flattest if free.flat[at]), None)
        if seed is None or region_sizes.flat[seed] < LEAST_REGION:
            break
        plane, members = planes.reshape(3, -1)[:, seed].astype(np.float64), None
        for _ in range(GROWTH_ROUNDS):
            near = np.abs(np.tensordot(plane, rays, 1) - inverse) < ON_PLANE_SIGMAS * sigma
            turned = np.tensordot(plane / np.linalg.norm(plane), normals, 1)
            members = free & near & (turned > np.cos(MOST_TURN_RAD))
            if members.sum() < 3:
                break
            weighted = rays[:, members] / sigma[members]
            plane = np.linalg.lstsq(weighted.T, inverse[members] / sigma[members], rcond=None)[0]
        free.flat[seed] = False
        if members is not None and members.mean() >= LEAST_SHARE:
            result[:, members] = plane[:, None]
            free &= ~members
    return result
