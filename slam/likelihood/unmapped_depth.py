"""Autoregressive density of depth where the map is empty: p(z_i | pixels above and to the left).

In raster order the factors multiply to a normalised density of an image of unknown, piecewise smooth
surfaces: whether there is a return, and its depth, a mixture of a Normal round the plane fitted to the
neighbours, Laplace densities round the plane of the two to the left and round the nearest depth, and a
uniform. A pose that covers more of the image with the map gains only what this density leaves unpredicted.

All constants by maximum likelihood on 26 images of five kinds, each with the noise of its own sensor
(docs/model.md, development films).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax.scipy.stats import norm

from recordings.types import NO_RETURN, DepthNoise
from shapes import depth_noise
from slam.keyframes.planes import ON_PLANE_SIGMAS

AROUND = tuple((row, column) for row in (-3, -2, -1, 0) for column in range(-4, 5 if row else 0))
"""Rows and columns, from a pixel, of those before it that a plane is fitted to."""

LEAST_ON_PLANE = 4
"""One more than the three parameters of a plane."""

CONTINUES, ENDS_BY_SHARE = 2.67, 13.4
"""Log odds that a plane which all pixels around lie on continues here, and what they lose by the share of the
pixels around that do not."""

OTHER_SHARES = (0.53, 0.44, 0.03)
"""Of surfaces that end it: those that continue the plane to the left, the depth to the left, any."""

OTHER_SCALES = (0.0033, 0.0079)
"""Laplace scales of the first two, relative to the depth expected."""

NONE_BY_NEIGHBOURS = (0.019, 0.235, 0.46, 0.61, 0.94)
"""Probability of no return by how many do not return of the four neighbours before: holes are patches."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PredictedDepth:
    """What is expected at each pixel.

    Attributes:
        depth_m: (3, ...) on the plane around, on the plane to the left, the depth to the left; `NO_RETURN`
            where there is none.
        share: (...) probability that the plane around continues.
        uncertainty: (...) variance of that plane's depth here, in units of a pixel's own.
        none: (...) probability of no return.
    """

    depth_m: jax.Array
    share: jax.Array
    uncertainty: jax.Array
    none: jax.Array

    @property
    def likeliest_m(self) -> jax.Array:
        """(...) depth on the plane around where that probably continues, else the depth to the left."""
        return jnp.where(self.share > 0.5, self.depth_m[0], self.depth_m[2])

    def plane(self, noise: DepthNoise) -> tuple[jax.Array, jax.Array]:
        """Depth on the plane around and standard deviation of the pixel's (...); 1 m where there is none."""
        depth = jnp.where(self.depth_m[0] > NO_RETURN, self.depth_m[0], 1.0)
        return depth, depth_noise.standard_deviation(noise, depth) * jnp.sqrt(1.0 + self.uncertainty)

    def others(self) -> Iterator[tuple[jax.Array, jax.Array, jax.Array]]:
        """Depth, share and Laplace scale (...) of the others; what is left over is the uniform's."""
        shares = [
            jnp.where(self.depth_m[index] > NO_RETURN, OTHER_SHARES[index - 1], 0.0) for index in (1, 2)
        ]
        total = shares[0] + shares[1] + OTHER_SHARES[2]
        for index, share, scale in zip((1, 2), shares, OTHER_SCALES, strict=True):
            depth = jnp.where(self.depth_m[index] > NO_RETURN, self.depth_m[index], 1.0)
            yield depth, (1.0 - self.share) * share / total, scale * depth


def log_density_of_unknown(observed_m: jax.Array, foreseen: PredictedDepth, noise: DepthNoise) -> jax.Array:
    """Log density of returns (...) from surfaces of which only the pixels before tell.

    s_0 Normal(z; e_0, sigma) + sum_j s_j Laplace(z; e_j, b_j) + s_any 1[0 <= z <= D] / D with expectations e,
    whose shares go to the others where there is none. Base measure: Lebesgue, metres.
    """
    inside = (observed_m >= 0) & (observed_m <= noise.max_range_m)
    depth, sigma = foreseen.plane(noise)
    density, left_over = foreseen.share * norm.pdf(observed_m, depth, sigma), 1.0 - foreseen.share
    for expected, share, scale in foreseen.others():
        density += share * jnp.exp(-jnp.abs(observed_m - expected) / scale) / (2.0 * scale)
        left_over -= share
    return jnp.log(density + left_over * jnp.where(inside, 1.0 / noise.max_range_m, 0.0))


def probability_nearer(depth_m: jax.Array, foreseen: PredictedDepth, noise: DepthNoise) -> jax.Array:
    """Probability that an unknown surface is nearer than `depth_m`: the same density's integral."""
    expected, sigma = foreseen.plane(noise)
    probability, left_over = foreseen.share * norm.cdf(depth_m, expected, sigma), 1.0 - foreseen.share
    for expected, share, scale in foreseen.others():
        tail = 0.5 * jnp.exp(-jnp.abs(depth_m - expected) / scale)
        probability += share * jnp.where(depth_m < expected, tail, 1.0 - tail)
        left_over -= share
    return probability + left_over * jnp.clip(depth_m / noise.max_range_m, 1e-3, 1.0)


def predict_from_neighbours(lattice_m: jax.Array, noise: DepthNoise) -> PredictedDepth:
    """What the pixels of a lattice (H, W) suggest of those that come after them in the order of lines.

    In a pinhole image inverse depth is affine along a plane: 1/z = 2/z_1 - 1/z_2.
    """
    near = jnp.pad(lattice_m[:, :-1], ((0, 0), (1, 0)))
    far = jnp.pad(lattice_m[:, :-2], ((0, 0), (2, 0)))
    both = (near > NO_RETURN) & (far > NO_RETURN)
    inverse = 2.0 / jnp.where(both, near, 1.0) - 1.0 / jnp.where(both, far, 1.0)
    ahead = both & (inverse > 0.5 / jnp.where(both, near, 1.0))
    planar = jnp.where(ahead, 1.0 / jnp.where(ahead, inverse, 1.0), NO_RETURN)
    around, share, uncertainty = _on_plane_around(lattice_m, noise)
    return PredictedDepth(
        jnp.stack([around, planar, near]), share, uncertainty, _probability_of_none(lattice_m)
    )


def _probability_of_none(lattice_m: jax.Array) -> jax.Array:
    """Of each pixel of a lattice (H, W), by the neighbours before it."""
    rows, columns = lattice_m.shape
    none = jnp.pad((lattice_m == NO_RETURN).astype(jnp.int32), ((1, 0), (1, 1)))
    above = sum(none[:rows, step : step + columns] for step in range(3))
    return jnp.asarray(NONE_BY_NEIGHBOURS)[above + none[1:, :columns]]


def _on_plane_around(lattice_m: jax.Array, noise: DepthNoise) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Depth (H, W) on the plane of the pixels `AROUND`, the probability that it continues, its uncertainty.

    Least squares, and again on those alone that lie on the first plane.
    """
    returned = lattice_m > NO_RETURN
    inverse = jnp.where(returned, 1.0 / jnp.where(returned, lattice_m, 1.0), 0.0)
    tolerance = ON_PLANE_SIGMAS * depth_noise.standard_deviation(noise, lattice_m) * inverse**2
    around = list(zip(AROUND, _neighbours(inverse), _neighbours(tolerance), strict=True))

    def lying_on(plane: _PlaneFit) -> list[jax.Array]:
        return [
            jnp.abs(near - plane.mean - plane.down * row - plane.right * column) < most
            for (row, column), near, most in around
        ]

    nearby = [near for _, near, _ in around]
    all_returned = [near > 0 for near in nearby]
    plane = _plane_fit(nearby, lying_on(_plane_fit(nearby, all_returned)))
    count, on_plane = (
        sum((one.astype(inverse.dtype) for one in some), start=jnp.zeros_like(inverse))
        for some in (all_returned, lying_on(plane))
    )
    known = (on_plane >= LEAST_ON_PLANE) & (plane.mean > 0)
    share = jax.nn.sigmoid(CONTINUES - ENDS_BY_SHARE * (count - on_plane) / (count + 1.0))
    depth = jnp.where(known, 1.0 / jnp.where(known, plane.mean, 1.0), NO_RETURN)
    return depth, jnp.where(known, share, 0.0), jnp.where(known, plane.uncertainty, 0.0)


def _neighbours(image: jax.Array) -> list[jax.Array]:
    """The pixels (H, W) `AROUND` each of an image, 0 beyond its border.

    A list: sums over it are one pass over the image, those over a stack are a pass for each.
    """
    rows, columns = image.shape
    above, aside = (max(abs(step) for step in steps) for steps in zip(*AROUND, strict=True))
    padded = jax.lax.optimization_barrier(jnp.pad(image, ((above, 0), (aside, aside))))
    return [padded[above + r : above + r + rows, aside + c : aside + c + columns] for r, c in AROUND]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _PlaneFit:
    """Value at the pixel itself, slopes, and variance of the value in units of a pixel's, all (H, W)."""

    mean: jax.Array
    down: jax.Array
    right: jax.Array
    uncertainty: jax.Array


def _plane_fit(inverse: list[jax.Array], counted: list[jax.Array]) -> _PlaneFit:
    """Least squares on inverse depths (H, W) of the pixels `AROUND`, those counted alone."""
    total = y = x = z = yy = xx = xy = yz = xz = jnp.zeros_like(inverse[0])
    for (row, column), near, use in zip(AROUND, inverse, counted, strict=True):
        weight = use.astype(near.dtype)
        total, y, x = total + weight, y + weight * row, x + weight * column
        yy, xx, xy = yy + weight * row**2, xx + weight * column**2, xy + weight * (row * column)
        z, yz, xz = z + weight * near, yz + weight * near * row, xz + weight * near * column
    total = jnp.maximum(total, 1.0)
    y, x, z, yy, xx, xy, yz, xz = (part / total for part in (y, x, z, yy, xx, xy, yz, xz))
    yy, xx, xy, yz, xz = yy - y * y + 1e-3, xx - x * x + 1e-3, xy - x * y, yz - y * z, xz - x * z
    determinant = xx * yy - xy * xy
    down, right = (xx * yz - xy * xz) / determinant, (yy * xz - xy * yz) / determinant
    leverage = (xx * y * y - 2.0 * xy * x * y + yy * x * x) / determinant
    return _PlaneFit(z - down * y - right * x, down, right, (1.0 + leverage) / total)
