"""p(I_t | x_t, map): the whole image as seen from a candidate pose, one normalised factor per pixel.

The map is rendered once, near the candidates (`slam.rendering`): each pixel then knows which surface
elements it sees. A candidate intersects its own rays with the tangent planes of those elements, so the
rendered depth never depends on the observed one.

Where the map shows nothing the world is not empty but unknown, and surfaces are smooth: the factor of
such a pixel is its density given the pixels before it, those above and to its left: Laplace around the plane
fitted to them, around the plane through two of them and around the nearest one's depth, mixed with the
uniform. Read line by line, the factors multiply to a normalised density of the image. The same density, cut
off at the map's surface, stands for things in front of it that no keyframe has seen. (The less smooth the
unknown is expected to be, the more a wrong place gains that covers more of the image: with uniforms alone it
beats the right one, 72 degrees round an object, by thousands of nats; with what two pixels say, by hundreds.)

Approximations, tested against rendering at the candidate itself: which element a pixel sees is that of
the nearby rendering, and a surface is its tangent plane over the few pixels that candidates differ by.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from recordings.types import NO_RETURN, DepthNoise
from shapes import depth_noise
from slam.components import dot, rotated
from slam.depth_view import DepthView
from slam.rendering import LEAST_INVERSE_DEPTH, MapImage

STRIDE_PX = 2
"""The density counts the pixels of this lattice; the exponents of the others are zero."""
UNKNOWN_NONE_PROBABILITY = 0.2
"""Of no return where the map shows nothing."""
UNSEEN_IN_FRONT = 0.01
"""Probability that something no keyframe has seen stands in front of the map's surface."""
UNKNOWN_SHARES = (0.6, 0.15, 0.15, 0.1)
"""Of unknown surfaces: those that continue the plane around, the plane to the left and the depth to the left;
and of any other."""
UNKNOWN_SIGMAS = 0.5
"""Laplace scale of the first, in standard deviations of the sensor."""
UNKNOWN_SCALES = (0.008, 0.06)
"""Of the second and third, relative to the depth expected."""
AROUND = tuple((row, column) for row in (-3, -2, -1, 0) for column in range(-4, 5 if row else 0))
"""Rows and columns, from a pixel, of those before it that a plane is fitted to."""
ON_PLANE_SIGMAS, LEAST_ON_PLANE = 3.5, 0.5
"""Within which a pixel lies on it, and the share of them that must."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ScoredPixels:
    """The lattice of pixels that the density counts, and what the map shows there.

    Attributes:
        observed_m: (P,) depth, `NO_RETURN` where none.
        measured: (P,) bool, False for canvas outside of the image.
        expected_m: (3, P) depths that the pixels before suggest, `NO_RETURN` where they do not.
        rays: (3, P).
        planes: (M, 3, P) in the keyframes' frames.
        weights: (M, P) inverse variances in 1/m^2.
    """

    observed_m: jax.Array
    measured: jax.Array
    expected_m: jax.Array
    rays: jax.Array
    planes: jax.Array
    weights: jax.Array


def log_density_of_unknown(observed_m: jax.Array, expected_m: jax.Array, noise: DepthNoise) -> jax.Array:
    """Log density of returns (...) from surfaces of which only the pixels before tell.

    sum_j s_j Laplace(z; e_j, b_j) + s_any 1[0 <= z <= D] / D with expectations e (3, ...), whose shares go to
    the uniform where there is none. Base measure: Lebesgue, metres.
    """
    inside = (observed_m >= 0) & (observed_m <= noise.max_range_m)
    density, left_over = jnp.zeros_like(observed_m), 1.0
    for expected, share, scale in _expectations(expected_m, noise):
        density += share * jnp.exp(-jnp.abs(observed_m - expected) / scale) / (2.0 * scale)
        left_over -= share
    return jnp.log(density + left_over * jnp.where(inside, 1.0 / noise.max_range_m, 0.0))


def probability_nearer(depth_m: jax.Array, expected_m: jax.Array, noise: DepthNoise) -> jax.Array:
    """Probability that an unknown surface is nearer than `depth_m`: the same density's integral."""
    probability, left_over = jnp.zeros_like(expected_m[0]), 1.0
    for expected, share, scale in _expectations(expected_m, noise):
        tail = 0.5 * jnp.exp(-jnp.abs(depth_m - expected) / scale)
        probability += share * jnp.where(depth_m < expected, tail, 1.0 - tail)
        left_over -= share
    return probability + left_over * jnp.clip(depth_m / noise.max_range_m, 1e-3, 1.0)


def _expectations(
    expected_m: jax.Array, noise: DepthNoise
) -> Iterator[tuple[jax.Array, jax.Array, jax.Array]]:
    """Depth, share and Laplace scale (...) of each expectation; where there is none the share is zero."""
    for index, share in enumerate(UNKNOWN_SHARES[:-1]):
        known = expected_m[index] > NO_RETURN
        expected = jnp.where(known, expected_m[index], 1.0)
        if index == 0:
            scale = UNKNOWN_SIGMAS * depth_noise.standard_deviation(noise, expected)
        else:
            scale = UNKNOWN_SCALES[index - 1] * expected
        yield expected, jnp.where(known, share, 0.0), scale


def expected_from_before(lattice_m: jax.Array, noise: DepthNoise) -> jax.Array:
    """Depths (3, H, W) at the pixels of a lattice (H, W), of those before them in the order of lines.

    On the plane that explains most of those around, on the plane of the two to the left, and of
    the one to the left. In a pinhole image inverse depth is affine along a plane: 1/z = 2/z_1 - 1/z_2.
    """
    near = jnp.pad(lattice_m[:, :-1], ((0, 0), (1, 0)))
    far = jnp.pad(lattice_m[:, :-2], ((0, 0), (2, 0)))
    both = (near > NO_RETURN) & (far > NO_RETURN)
    inverse = 2.0 / jnp.where(both, near, 1.0) - 1.0 / jnp.where(both, far, 1.0)
    ahead = both & (inverse > 0.5 / jnp.where(both, near, 1.0))
    planar = jnp.where(ahead, 1.0 / jnp.where(ahead, inverse, 1.0), NO_RETURN)
    return jnp.stack([_on_plane_around(lattice_m, noise), planar, near])


def _on_plane_around(lattice_m: jax.Array, noise: DepthNoise) -> jax.Array:
    """Depth (H, W) on the plane that most pixels `AROUND` lie on: least squares, again on those alone."""
    rows, columns = lattice_m.shape
    above, aside = (max(abs(step) for step in steps) for steps in zip(*AROUND, strict=True))
    padded = jnp.pad(lattice_m, ((above, 0), (aside, aside)))
    around = jnp.stack(
        [padded[above + r : above + r + rows, aside + c : aside + c + columns] for r, c in AROUND]
    )
    returned = around > NO_RETURN
    inverse = jnp.where(returned, 1.0 / jnp.where(returned, around, 1.0), 0.0)
    tolerance = ON_PLANE_SIGMAS * depth_noise.standard_deviation(noise, around) * inverse**2
    offsets = np.asarray(AROUND, np.float32)[:, :, None, None]
    row, column = jnp.asarray(offsets[:, 0]), jnp.asarray(offsets[:, 1])

    def lying_on(plane: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        residual = inverse - plane[0][None] - plane[1][None] * row - plane[2][None] * column
        return returned & (jnp.abs(residual) < tolerance)

    first = lying_on(_plane_fit(inverse, returned, row, column))
    second = _plane_fit(inverse, first, row, column)
    mean, on_plane = second[0], lying_on(second)
    plane = (on_plane.sum(0) >= LEAST_ON_PLANE * len(AROUND)) & (mean > 0)
    return jnp.where(plane, 1.0 / jnp.where(plane, mean, 1.0), NO_RETURN)


def _plane_fit(
    inverse: jax.Array, counted: jax.Array, row: jax.Array, column: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Value at the pixel itself and slopes (H, W) of inverse depths (n, H, W), those counted alone."""
    weight = counted.astype(inverse.dtype)
    total = jnp.maximum(weight.sum(0), 1.0)

    def mean(values: jax.Array) -> jax.Array:
        return (weight * values).sum(0) / total

    y, x, z = mean(row), mean(column), mean(inverse)
    yy, xx, xy = mean(row**2) - y * y + 1e-3, mean(column**2) - x * x + 1e-3, mean(row * column) - x * y
    yz, xz = mean(row * inverse) - y * z, mean(column * inverse) - x * z
    determinant = xx * yy - xy * xy
    down, right = (xx * yz - xy * xz) / determinant, (yy * xz - xy * yz) / determinant
    return z - down * y - right * x, down, right


def log_unknown_factors(observed_m: jax.Array, expected_m: jax.Array, noise: DepthNoise) -> jax.Array:
    """Log factors of pixels where the map shows nothing: the atom of no return, or an unknown surface."""
    return jnp.where(
        observed_m == NO_RETURN,
        jnp.log(UNKNOWN_NONE_PROBABILITY),
        jnp.log1p(-UNKNOWN_NONE_PROBABILITY) + log_density_of_unknown(observed_m, expected_m, noise),
    )


def log_hit_factors(
    observed_m: jax.Array, expected_m: jax.Array, depth_m: jax.Array, sigma_m: jax.Array, noise: DepthNoise
) -> jax.Array:
    """Log factors of pixels whose rays meet the map at `depth_m`, known to `sigma_m`."""
    log_surface = depth_noise.log_density_of_hit(noise, observed_m, depth_m, sigma_m)
    log_in_front = (
        jnp.log1p(-noise.none_hit_probability)
        + log_density_of_unknown(observed_m, expected_m, noise)
        - jnp.log(probability_nearer(depth_m, expected_m, noise))
    )
    log_in_front = jnp.where(observed_m < depth_m, log_in_front, -jnp.inf)
    return jnp.where(
        observed_m == NO_RETURN,
        log_surface,
        jnp.logaddexp(jnp.log1p(-UNSEEN_IN_FRONT) + log_surface, jnp.log(UNSEEN_IN_FRONT) + log_in_front),
    )


def scored_pixels(view: DepthView, image: MapImage, noise: DepthNoise) -> ScoredPixels:
    """The lattice of a view against the map's image from nearby."""
    every = slice(None, None, STRIDE_PX)
    layers = len(image.planes)
    return ScoredPixels(
        observed_m=view.depth_m[every, every].ravel(),
        measured=view.measured[every, every].ravel(),
        expected_m=expected_from_before(view.depth_m[every, every], noise).reshape(3, -1),
        rays=view.rays[:, every, every].reshape(3, -1),
        planes=image.planes[:, :, every, every].reshape(layers, 3, -1),
        weights=image.weights[:, every, every].reshape(layers, -1),
    )


def rendered_depth(pixels: ScoredPixels, keyframes_from_camera: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Depth (P,) that a camera at (M, 7) sees, +inf for a miss, and its variance (P,)."""

    def layer(planes: jax.Array, weights: jax.Array, pose: jax.Array) -> tuple[jax.Array, jax.Array]:
        keyframe_from_camera = jaxlie.SE3(pose)
        slope = dot(planes, rotated(keyframe_from_camera.rotation().as_matrix(), pixels.rays))
        height = 1.0 - dot(keyframe_from_camera.translation(), planes)
        ahead = (weights > 0) & (height > 0) & (slope > LEAST_INVERSE_DEPTH * height)
        return jnp.where(ahead, height / jnp.where(ahead, slope, 1.0), 0.0), jnp.where(ahead, weights, 0.0)

    total, weighted = jnp.zeros_like(pixels.observed_m), jnp.zeros_like(pixels.observed_m)
    for index in range(len(keyframes_from_camera)):
        depth, weights = layer(pixels.planes[index], pixels.weights[index], keyframes_from_camera[index])
        total, weighted = total + weights, weighted + weights * depth
    hit = total > 0
    safe_total = jnp.where(hit, total, 1.0)
    return jnp.where(hit, weighted / safe_total, jnp.inf), 1.0 / safe_total


def log_image_density(
    pixels: ScoredPixels, keyframes_from_camera: jax.Array, noise: DepthNoise, exponent: jax.Array | float
) -> jax.Array:
    """Tempered log density of the image from the pose that sees the map's keyframes at (M, 7)."""
    depth, variance = rendered_depth(pixels, keyframes_from_camera)
    hit = jnp.isfinite(depth)
    log_factors = jnp.where(
        hit,
        log_hit_factors(
            pixels.observed_m, pixels.expected_m, jnp.where(hit, depth, 1.0), jnp.sqrt(variance), noise
        ),
        log_unknown_factors(pixels.observed_m, pixels.expected_m, noise),
    )
    return exponent * jnp.where(pixels.measured, log_factors, 0.0).sum()
