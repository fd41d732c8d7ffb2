"""What the pixels before one suggest of it: surfaces are smooth, also those that no map shows.

Read line by line, the density of each pixel given those above and to its left multiplies to a normalised
density of an image of the unknown: Laplace around the plane fitted to them, around the plane through the two
to the left and around the nearest one's depth, mixed with the uniform. The less well the unknown is foreseen,
the more a wrong place gains that covers more of the image with a map.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from recordings.types import NO_RETURN, DepthNoise
from shapes import depth_noise

AROUND = tuple((row, column) for row in (-3, -2, -1, 0) for column in range(-4, 5 if row else 0))
"""Rows and columns, from a pixel, of those before it that a plane is fitted to."""
ON_PLANE_SIGMAS = 3.5
"""Within which a pixel lies on it."""
END_OF_PLANE, END_BY_PIXEL = 0.002, 0.0435
"""Probability that a plane which all pixels around lie on ends here, and what each that does not adds. These
and the following by maximum likelihood on 17 images: kitchen, bare and furnished room, views of an object
(development seed 101): 2.0 to 2.8 nats a return became 2.9 to 3.9."""
PLANE_SIGMAS = 0.75
"""Laplace scale around that plane, in standard deviations of the sensor."""
OTHER_SHARES = (0.56, 0.40, 0.04)
"""Of surfaces that end it: those that continue the plane to the left, the depth to the left, any."""
OTHER_SCALES = (0.0035, 0.007)
"""Laplace scales of the first two, relative to the depth expected."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Foreseen:
    """What is expected at each pixel.

    Attributes:
        depth_m: (3, ...) on the plane around, on the plane to the left, the depth to the left; `NO_RETURN`
            where there is none.
        share: (...) probability that the plane around continues.
    """

    depth_m: jax.Array
    share: jax.Array

    @property
    def likeliest_m(self) -> jax.Array:
        """(...) depth on the plane around where that probably continues, else the depth to the left."""
        return jnp.where(self.share > 0.5, self.depth_m[0], self.depth_m[2])

    def terms(self, noise: DepthNoise) -> Iterator[tuple[jax.Array, jax.Array, jax.Array]]:
        """Depth, share and Laplace scale (...) of each expectation; what is left over is the uniform's."""
        known = [self.depth_m[index] > NO_RETURN for index in range(3)]
        depth = [jnp.where(known[index], self.depth_m[index], 1.0) for index in range(3)]
        yield depth[0], self.share, PLANE_SIGMAS * depth_noise.standard_deviation(noise, depth[0])
        others = [jnp.where(known[index], OTHER_SHARES[index - 1], 0.0) for index in (1, 2)]
        total = others[0] + others[1] + OTHER_SHARES[2]
        for index, other, scale in zip((1, 2), others, OTHER_SCALES, strict=True):
            yield depth[index], (1.0 - self.share) * other / total, scale * depth[index]


def log_density_of_unknown(observed_m: jax.Array, foreseen: Foreseen, noise: DepthNoise) -> jax.Array:
    """Log density of returns (...) from surfaces of which only the pixels before tell.

    sum_j s_j Laplace(z; e_j, b_j) + s_any 1[0 <= z <= D] / D with expectations e, whose shares go to the
    others where there is none. Base measure: Lebesgue, metres.
    """
    inside = (observed_m >= 0) & (observed_m <= noise.max_range_m)
    density, left_over = jnp.zeros_like(observed_m), 1.0
    for expected, share, scale in foreseen.terms(noise):
        density += share * jnp.exp(-jnp.abs(observed_m - expected) / scale) / (2.0 * scale)
        left_over -= share
    return jnp.log(density + left_over * jnp.where(inside, 1.0 / noise.max_range_m, 0.0))


def probability_nearer(depth_m: jax.Array, foreseen: Foreseen, noise: DepthNoise) -> jax.Array:
    """Probability that an unknown surface is nearer than `depth_m`: the same density's integral."""
    probability, left_over = jnp.zeros_like(foreseen.share), 1.0
    for expected, share, scale in foreseen.terms(noise):
        tail = 0.5 * jnp.exp(-jnp.abs(depth_m - expected) / scale)
        probability += share * jnp.where(depth_m < expected, tail, 1.0 - tail)
        left_over -= share
    return probability + left_over * jnp.clip(depth_m / noise.max_range_m, 1e-3, 1.0)


def foreseen_from_before(lattice_m: jax.Array, noise: DepthNoise) -> Foreseen:
    """What the pixels of a lattice (H, W) suggest of those that come after them in the order of lines.

    In a pinhole image inverse depth is affine along a plane: 1/z = 2/z_1 - 1/z_2.
    """
    near = jnp.pad(lattice_m[:, :-1], ((0, 0), (1, 0)))
    far = jnp.pad(lattice_m[:, :-2], ((0, 0), (2, 0)))
    both = (near > NO_RETURN) & (far > NO_RETURN)
    inverse = 2.0 / jnp.where(both, near, 1.0) - 1.0 / jnp.where(both, far, 1.0)
    ahead = both & (inverse > 0.5 / jnp.where(both, near, 1.0))
    planar = jnp.where(ahead, 1.0 / jnp.where(ahead, inverse, 1.0), NO_RETURN)
    around, share = _on_plane_around(lattice_m, noise)
    return Foreseen(jnp.stack([around, planar, near]), share)


def _on_plane_around(lattice_m: jax.Array, noise: DepthNoise) -> tuple[jax.Array, jax.Array]:
    """Depth (H, W) on the plane of the pixels `AROUND`, and the probability that it continues.

    Least squares, and again on those alone that lie on the first plane.
    """
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
    share = 1.0 - END_OF_PLANE - END_BY_PIXEL * (len(AROUND) - on_plane.sum(0))
    plane = (share > 0) & (mean > 0)
    return jnp.where(plane, 1.0 / jnp.where(plane, mean, 1.0), NO_RETURN), jnp.where(plane, share, 0.0)


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
