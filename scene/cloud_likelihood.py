"""How probable an observed point cloud is given a rendered depth image (main paper, section 3.3).

p(Y | Y~) = prod_i ( C / B + (1 - C) / K~ sum_j 1[|y_i - y~_j| <= r] / (4/3 pi r^3) ): every observed point
is an outlier in the volume B or lies uniformly in a ball round one of the K~ rendered points. Base measure:
Lebesgue in cubic metres for each point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from shapes.camera import Camera


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CloudNoise:
    """Parameters of the point-cloud density.

    Attributes:
        outlier_probability: C, share of observed points that no surface explains.
        outlier_volume_m3: B, where outliers are uniform.
        radius_m: r of the ball round a rendered point.
    """

    outlier_probability: jax.Array | float = 0.01
    outlier_volume_m3: jax.Array | float = 1.0
    radius_m: jax.Array | float = 0.005


def window_half_width(radius_m: float, nearest_m: float, focal_px: float, half_image_px: float) -> int:
    """Pixels to each side within which every rendered point of a ball's radius lies.

    f (tan(a + asin(r / d)) - tan a) at the border of the image, where a ray leans by a, plus half a pixel
    of rounding.

    Args:
        radius_m: r.
        nearest_m: least depth of an observed point.
        focal_px: focal length.
        half_image_px: largest distance of an observed point from the principal point along that axis.

    Raises:
        ValueError: the ball reaches the camera.
    """
    slope = half_image_px / focal_px
    distance = nearest_m * math.hypot(1.0, slope)
    angle = math.atan(slope) + math.asin(min(radius_m / distance, 1.0))
    if radius_m >= distance or angle >= math.pi / 2:
        raise ValueError(f"a ball of {radius_m} m round a point at depth {nearest_m} m reaches the camera")
    return math.ceil(focal_px * (math.tan(angle) - slope) + 0.5)


def log_density(
    noise: CloudNoise, camera: Camera, points_m: jax.Array, rendered_m: jax.Array, half_width: int
) -> jax.Array:
    """Log density () of observed points (K, 3) given a rendered depth image (H, W)."""
    count = neighbour_counts(noise.radius_m, camera, points_m, rendered_m, half_width)
    rendered = jnp.isfinite(rendered_m).sum()
    outlier = jnp.where(rendered > 0, noise.outlier_probability, 1.0)
    ball = 4.0 / 3.0 * jnp.pi * noise.radius_m**3
    inlier = (1.0 - outlier) * count / (jnp.maximum(rendered, 1) * ball)
    density = jnp.log(outlier / noise.outlier_volume_m3 + inlier)
    return jnp.where(points_m[:, 2] > 0, density, 0.0).sum()


def neighbour_counts(
    radius_m: jax.Array | float, camera: Camera, points_m: jax.Array, rendered_m: jax.Array, half_width: int
) -> jax.Array:
    """Rendered points (K,) within the radius of each observed point (K, 3), looked up in a pixel window."""
    height, width = rendered_m.shape
    x, y, z = points_m.T
    depth = jnp.where(z > 0, z, 1.0)
    column = jnp.round(camera.fx * x / depth + camera.cx)
    row = jnp.round(camera.fy * y / depth + camera.cy)
    reach = jnp.arange(-half_width, half_width + 1, dtype=jnp.float32)
    side = len(reach)

    def add(step: jax.Array, count: jax.Array) -> jax.Array:
        u, v = column + reach[step % side], row + reach[step // side]
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        index = jnp.where(inside, v * width + u, 0).astype(jnp.int32)
        there = rendered_m.reshape(-1)[index]
        square = ((u - camera.cx) / camera.fx * there - x) ** 2
        square += ((v - camera.cy) / camera.fy * there - y) ** 2 + (there - z) ** 2
        return count + (inside & jnp.isfinite(there) & (square <= radius_m**2))

    return jax.lax.fori_loop(0, side * side, add, jnp.zeros(len(points_m), jnp.int32))
