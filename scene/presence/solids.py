"""Unknown solids: boxes and cylinders of free size that nobody asked for, seen as what is asked for is seen.

A shape that is asked for has to explain an image better than some box or cylinder does, and not better than
nothing in particular. Their number is Poisson, sizes are log-uniform, poses have the prior of all objects.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

from scene.execution import map_parallel
from scene.likelihood.crops import Crops, crops_around
from scene.presence.gaussian_fits import moved
from shapes.geometry.camera import Camera
from shapes.geometry.poses import matrices_of, placed_points
from shapes.geometry.rotation_densities import LOG_CONTACT_JACOBIAN

LEAST_M, GREATEST_M = 0.003, 0.3
"""Of half sizes: a magazine's thickness to what stands on a table."""

RATE = 1.0
"""Expected number of each kind, before anything is seen."""

FREE_OF_CYLINDERS = np.array([1, 1, 1, 1, 1, 0, 1, 0, 1])
"""Which steps change a cylinder: not its spin, nor its radius twice."""

BOX_TURNS, CYLINDER_TURNS = 24, 2
"""Ways in which one solid is told: axes exchanged, with the sizes; the ends."""


NEAREST_M = 0.01
"""Of corners that are projected."""

LEAST_SINC = 1e-6
"""Of an angle's sine over it, which vanishes where a turn is the farthest one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SolidFits:
    """Gaussians on solids, each round one; what is drawn from all of a kind together.

    Attributes:
        is_round: (U,) which are cylinders.
        centres: (U, 10) world_from_solid and logs of half sizes.
        factors: (U, 9, 9) lower factors of offset, turn and logs of sizes; a cylinder's spin and second
            radius are not told by them.
    """

    is_round: NDArray[np.bool_]
    centres: NDArray[np.float64]
    factors: NDArray[np.float64]

    @classmethod
    def none(cls) -> SolidFits:
        """Of no solids."""
        return cls(is_round=np.zeros(0, bool), centres=np.zeros((0, 10)), factors=np.zeros((0, 9, 9)))

    def drawn(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """States (U, count, 10), a draw from each."""
        normal = rng.standard_normal((len(self.centres), count, 9))
        steps = np.einsum("uij,ukj->uki", self.factors, normal)
        steps[self.is_round] = steps[self.is_round] * FREE_OF_CYLINDERS
        states = moved(self.centres, steps)
        spins = np.zeros_like(steps)
        spins[self.is_round, :, 5] = rng.uniform(-np.pi, np.pi, (int(self.is_round.sum()), count))
        states = moved(states.reshape(-1, 10), spins.reshape(-1, 1, 9)).reshape(states.shape)
        return tied(states, self.is_round)

    def log_density(self, states: NDArray[np.float64], is_round: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Log density (n, K) of states (n, K, 10) of kinds (n,): the sum over the Gaussians of that kind.

        Of a solid in whatever way it is told: the sum over all of them. Lebesgue times rotations of mass pi^2
        times Lebesgue for the logs of sizes.
        """
        total = np.full(states.shape[:2], -np.inf)
        for kind in np.unique(is_round).tolist():
            told = _tellings(states[is_round == kind], is_round=kind)
            parts = [self._log_normal(one, told) for one in np.flatnonzero(self.is_round == kind).tolist()]
            total[is_round == kind] = logsumexp(parts, axis=(0, 1))
        return total

    def _log_normal(self, one: int, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density (...) of one Gaussian at states (..., 10) as they are told."""
        steps, is_round = self._steps(one, states), self.is_round[one]
        free = np.flatnonzero(FREE_OF_CYLINDERS) if is_round else np.arange(9)
        covariance = self.factors[one] @ self.factors[one].T
        factor = np.linalg.cholesky(covariance[np.ix_(free, free)])
        white = steps[..., free] @ np.linalg.inv(factor).T
        log_normal = -0.5 * (white**2).sum(axis=-1) - np.log(np.diag(factor)).sum()
        log_normal -= len(free) / 2 * math.log(2 * math.pi)
        angles = np.linalg.norm(steps[..., 3:6], axis=-1)
        if is_round:  # an area of directions is sin(t) / t of one in the chart
            return log_normal + LOG_CONTACT_JACOBIAN - math.log(2 * math.pi) - _log_sinc(angles)
        return log_normal + LOG_CONTACT_JACOBIAN - 2 * _log_sinc(angles / 2)

    def _steps(self, one: int, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Steps (..., 9) from a centre to states (..., 10)."""
        centre = self.centres[one]
        turn = Rotation.from_quat(centre[:4], scalar_first=True).inv()
        turns = turn * Rotation.from_quat(states[..., :4].reshape(-1, 4), scalar_first=True)
        if self.is_round[one]:  # how the axis tilts; the spin is free
            axis = turns.as_matrix()[:, :, 2]
            angle = np.arccos(np.clip(axis[:, 2], -1, 1))
            scale = angle / np.maximum(np.sin(angle), 1e-12)
            tangents = np.stack([-axis[:, 1] * scale, axis[:, 0] * scale, np.zeros(len(axis))], axis=1)
        else:
            tangents = turns.as_rotvec()
        tangents = tangents.reshape(*states.shape[:-1], 3)
        return np.concatenate(
            [states[..., 4:7] - centre[4:7], tangents, states[..., 7:] - centre[7:]], axis=-1
        )


def _tellings(states: NDArray[np.float64], *, is_round: bool) -> NDArray[np.float64]:
    """Solids (..., 10) told in all ways (W, ..., 10): axes exchanged, with the sizes, or the ends."""
    turns = _HALF_TURN if is_round else _TURNS_OF_A_BOX
    before = Rotation.from_quat(states[..., :4].reshape(-1, 4), scalar_first=True)
    told = np.tile(states, (len(turns), *[1] * states.ndim))
    for one, turn in enumerate(turns):
        after = (before * turn).as_quat(scalar_first=True)
        told[one, ..., :4] = after.reshape(*states.shape[:-1], 4)
        told[one, ..., 7:] = states[..., 7 + np.abs(turn.as_matrix()).argmax(axis=0)]
    return told


_TURNS_OF_A_BOX = Rotation.create_group("O")

_HALF_TURN = Rotation.from_rotvec([[0.0, 0.0, 0.0], [np.pi, 0.0, 0.0]])


def _log_sinc(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log of sin(t) / t (...) of angles from 0 to pi."""
    return np.log(np.maximum(np.sinc(angles / np.pi), LEAST_SINC))


def tied(states: NDArray[np.float64], is_round: NDArray[np.bool_]) -> NDArray[np.float64]:
    """States (U, ..., 10) in which both radii of cylinders are the first."""
    states = np.array(states)
    states[is_round, ..., 8] = states[is_round, ..., 7]
    return states


def solid_half_sizes(states: NDArray[np.float64]) -> NDArray[np.float64]:
    """Half sizes (..., 3) of solids (..., 10), within the bounds of their prior, beyond which it is zero.

    Fits to what explains nothing are wide, and the exponentials of their draws would overflow.
    """
    return np.exp(np.clip(states[..., 7:], math.log(LEAST_M), math.log(GREATEST_M)))


def log_sizes_density(log_half: NDArray[np.float64], is_round: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Log density (...) of logs of half sizes (..., 3), of cylinders radius twice and height, with the rate.

    All ways of telling a solid count together: one of them is looked at.
    """
    inside = ((log_half >= math.log(LEAST_M)) & (log_half <= math.log(GREATEST_M))).all(axis=-1)
    sizes, turns = np.where(is_round, 2, 3), np.where(is_round, CYLINDER_TURNS, BOX_TURNS)
    log_density = math.log(RATE) + np.log(turns) - sizes * math.log(math.log(GREATEST_M / LEAST_M))
    return np.where(inside, log_density, -np.inf)


def solid_layers(
    camera: Camera,
    poses: NDArray[np.floating],
    half_m: NDArray[np.floating],
    is_round: NDArray[np.bool_],
    height: int,
    width: int,
) -> NDArray[np.float32]:
    """Depth (n, height, width) of solids alone, +inf beside them.

    Args:
        camera: of a window.
        poses: (n, 7) camera_from_solid.
        half_m: (n, 3) half sizes; of cylinders the first is the radius, the last lies along the axis.
        is_round: (n,) which are cylinders.
        height: of the window.
        width: of the window.
    """
    layers_m = np.full((len(poses), height, width), np.float32(np.inf))
    given = poses.astype(np.float32), half_m.astype(np.float32), is_round

    def render(crops: Crops) -> None:
        mine = [crops.filled(part[crops.members]) for part in given]
        corners = crops.filled(crops.corners)
        crops.put(layers_m, np.asarray(_cropped_layers(camera, *mine, corners, *crops.size)))

    sides_m = np.where(is_round[:, None], half_m[:, [0, 0, 2]], half_m)
    bounds = _lines_around(camera, poses, sides_m, (height, width))
    map_parallel(render, crops_around(*bounds, (height, width)))
    return layers_m


def _lines_around(
    camera: Camera, poses: NDArray[np.floating], half_m: NDArray[np.floating], shape: tuple[int, int]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First rows and columns (n, 2) of what boxes may cover in an image, and those after the last.

    These are 0 of what is beside the image, and all of it of what reaches behind the camera.
    """
    corners = _CORNERS * half_m[:, None]
    camera_from_box = matrices_of(np.asarray(poses, np.float64))
    x, y, z = np.moveaxis(placed_points(camera_from_box, corners), -1, 0)
    in_front = (z > NEAREST_M).all(axis=1, keepdims=True)
    z = np.maximum(z, NEAREST_M)
    lines = np.stack([y / z * camera.fy + camera.cy, x / z * camera.fx + camera.cx], axis=-1)
    first = np.where(in_front, np.floor(lines.min(axis=1)), 0).clip(0, shape)
    after = np.where(in_front, np.ceil(lines.max(axis=1)) + 1, shape).clip(0, shape)
    seen = (first < after).all(axis=1, keepdims=True)
    return first.astype(np.intp), np.where(seen, after, 0).astype(np.intp)


_CORNERS = np.stack(np.meshgrid(*3 * [[-1.0, 1.0]], indexing="ij"), axis=-1).reshape(8, 3)


@partial(jax.jit, static_argnames=("height", "width"))
def _cropped_layers(
    camera: Camera,
    poses: jax.Array,
    half_m: jax.Array,
    is_round: jax.Array,
    corners: jax.Array,
    height: int,
    width: int,
) -> jax.Array:
    """Depth (n, height, width) of solids in parts of an image with these first rows and columns (n, 2).

    Args:
        camera: of the image.
        poses: (n, 7) camera_from_solid.
        half_m: (n, 3) half sizes; of cylinders the first is the radius, the last lies along the axis.
        is_round: (n,) which are cylinders.
        corners: int32.
        height: of the parts.
        width: of the parts.
    """

    def layer(pose: jax.Array, half_m: jax.Array, is_round: jax.Array, corner: jax.Array) -> jax.Array:
        rows, columns = corner[0] + jnp.arange(height), corner[1] + jnp.arange(width)
        columns, rows = jnp.meshgrid(columns, rows)
        rays = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, jnp.ones(columns.shape)
        rays = jnp.stack(rays, axis=-1).astype(jnp.float32)
        rotation = jaxlie.SO3(pose[:4]).as_matrix()
        towards, start = rays @ rotation, -pose[4:] @ rotation
        towards = jnp.where(jnp.abs(towards) < 1e-9, 1e-9, towards)
        ends = jnp.stack([side[None, None] / towards for side in (-half_m - start, half_m - start)])
        enters, leaves = jnp.min(ends, axis=0), jnp.max(ends, axis=0)
        a = jnp.sum(towards[..., :2] ** 2, axis=-1)
        b = towards[..., :2] @ start[:2]
        root = b * b - a * (jnp.sum(start[:2] ** 2) - half_m[0] ** 2)
        half_chord = jnp.sqrt(jnp.maximum(root, 0.0))
        round_in = jnp.where(root > 0, (-b - half_chord) / a, jnp.inf)
        round_out = jnp.where(root > 0, (-b + half_chord) / a, -jnp.inf)
        flat_in, flat_out = (jnp.max(enters[..., :2], axis=-1), jnp.min(leaves[..., :2], axis=-1))
        near = jnp.maximum(enters[..., 2], jnp.where(is_round, round_in, flat_in))
        far = jnp.minimum(leaves[..., 2], jnp.where(is_round, round_out, flat_out))
        return jnp.where((near < far) & (near > 0), near, jnp.inf)

    return jax.lax.map(lambda solid: layer(*solid), (poses, half_m, is_round, corners))
