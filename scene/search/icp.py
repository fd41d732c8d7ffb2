"""Iterative closest point of the visible surface against a depth view, many hypotheses at once."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie

from scene.observation.depth_view import PooledView
from shapes.geometry.camera import Camera

GRAZING = -0.15
"""Cosine between normal and ray above which a surface point is not seen."""

DAMPING = (0.1, 0.1, 0.1, 1e-4, 1e-4, 1e-4)
"""Of the normal equations, in weights and weights m^2: what nothing constrains stays."""

NORMAL_STEPS = 511
"""Of a normal's component, kept in ten bits with its sign."""

Vector = Any
"""Components x, y, z: three arrays of one shape."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ViewTable:
    """A depth view in two words a pixel, for look-ups that are mostly waiting for memory.

    Attributes:
        camera: of the view.
        depth_m: (H * W,).
        code: (H * W,) int32: 3 x 10 bits of normal, one spare, and whether the pixel is unexplained.
        height, width: of the view.
    """

    camera: Camera
    depth_m: jax.Array
    code: jax.Array
    height: int = field(metadata={"static": True})
    width: int = field(metadata={"static": True})

    @classmethod
    def of(cls, view: PooledView) -> ViewTable:
        """The table of a view."""
        x, y, z = jnp.moveaxis(jnp.round(view.normals * NORMAL_STEPS).astype(jnp.int32) & 1023, -1, 0)
        code = x << 22 | y << 12 | z << 2 | view.unexplained.astype(jnp.int32)
        return cls(view.camera, view.depth_m.reshape(-1), code.reshape(-1), *view.depth_m.shape)


@dataclass(frozen=True)
class Correspondence:
    """What a view shows where points project.

    Attributes:
        depth_m: of the observed surface, along the ray of the pixel (`ray_x`, `ray_y`, 1).
        ray_x, ray_y: of the pixel's middle.
        normal: towards the camera, of unit length; zero where unknown.
        measured: whether there is a measurement.
        unexplained: whether it waits for an object.
    """

    depth_m: jax.Array
    ray_x: jax.Array
    ray_y: jax.Array
    normal: Vector
    measured: jax.Array
    unexplained: jax.Array


def look_up(view: ViewTable, point: Vector) -> Correspondence:
    """The observed points onto which points project."""
    camera = view.camera
    x, y, z = point
    inverse = 1 / jnp.maximum(z, 1e-3)
    u = jnp.floor(camera.fx * x * inverse + camera.cx + 0.5).astype(jnp.int32)
    v = jnp.floor(camera.fy * y * inverse + camera.cy + 0.5).astype(jnp.int32)
    inside = (u >= 0) & (u < view.width) & (v >= 0) & (v < view.height) & (z > 1e-3)
    place = jnp.where(inside, v * view.width + u, 0)
    depth = view.depth_m.at[place].get(mode="promise_in_bounds")
    code = view.code.at[place].get(mode="promise_in_bounds")
    return Correspondence(
        depth_m=depth,
        ray_x=(u - camera.cx) / camera.fx,
        ray_y=(v - camera.cy) / camera.fy,
        normal=[(code << shift >> 22) * (1.0 / NORMAL_STEPS) for shift in (0, 10, 20)],
        measured=inside & (depth > 0),
        unexplained=(code & 1) == 1,
    )


def faces_camera(point: Vector, normal: Vector) -> jax.Array:
    """Which surface points face the camera at the origin."""
    return dot(point, normal) < GRAZING * jnp.sqrt(dot(point, point))


@partial(jax.jit, static_argnames="iterations")
def align(
    view: ViewTable,
    points_m: jax.Array,
    normals: jax.Array,
    visible: jax.Array,
    poses: jax.Array,
    first_m: jax.Array | float,
    last_m: jax.Array | float,
    iterations: int,
) -> jax.Array:
    """Poses (K, 7) camera_from_box after point-to-plane ICP with projective correspondences.

    Each point takes the depth pixel onto which it falls; Geman-McClure weights narrow from `first_m` to
    `last_m`. A point takes part if it faces the camera, if the pixel is unexplained, the normals agree and
    the depths differ by less than four scales.

    Args:
        view: the observation.
        points_m: (P, 3) surface points in the box frame.
        normals: (P, 3).
        visible: (K, P) whether each hypothesis shows the point, from a rendering.
        poses: (K, 7) wxyz_xyz.
        first_m: scale of the residuals at the start.
        last_m: scale at the end.
        iterations: of Gauss-Newton.
    """
    scales = first_m * (last_m / first_m) ** jnp.linspace(0, 1, iterations)

    def improve(pose: jax.Array, scale: jax.Array, shown: jax.Array) -> jax.Array:
        rotation = jaxlie.SO3(pose[:4]).as_matrix()
        arm, outward = rotated(rotation, points_m), rotated(rotation, normals)
        placed = [arm[axis] + pose[4 + axis] for axis in range(3)]
        observed = look_up(view, placed)
        gap = observed.depth_m - placed[2]
        depth = observed.depth_m
        offset = [observed.ray_x * depth - placed[0], observed.ray_y * depth - placed[1], gap]
        residual = dot(outward, offset)
        agree = (dot(observed.normal, outward) > 0.3) & (jnp.abs(gap) < 4 * scale)
        use = shown & observed.measured & observed.unexplained & agree & faces_camera(placed, outward)
        weight = jnp.where(use, (1 + (residual / scale) ** 2) ** -2, 0.0)
        columns = jnp.stack([*outward, *_cross(arm, outward)])
        matrix = (weight[None] * columns) @ columns.T + jnp.diag(jnp.asarray(DAMPING))
        step = jnp.linalg.solve(matrix, columns @ (weight * residual))
        turned = jaxlie.SO3.exp(step[3:]) @ jaxlie.SO3(pose[:4])
        return jnp.concatenate([turned.normalize().wxyz, pose[4:] + step[:3]])

    def narrow(poses: jax.Array, scale: jax.Array) -> tuple[jax.Array, None]:
        return jax.vmap(improve, in_axes=(0, None, 0))(poses, scale, visible), None

    return jax.lax.scan(narrow, poses, scales)[0]


def rotated(rotation: jax.Array, vectors: jax.Array) -> Vector:
    """Components of rotated vectors (P, 3)."""
    x, y, z = vectors.T
    return [rotation[axis, 0] * x + rotation[axis, 1] * y + rotation[axis, 2] * z for axis in range(3)]


def dot(a: Vector, b: Vector) -> jax.Array:
    """Inner products."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
