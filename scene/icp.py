"""Iterative closest point of the visible surface against a depth view, many hypotheses at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie

from scene.observation import DepthView

GRAZING = -0.15
"""Cosine between normal and ray above which a surface point is not seen."""
DAMPING = (0.1, 0.1, 0.1, 1e-4, 1e-4, 1e-4)
"""Of the normal equations, in weights and weights m^2: what nothing constrains stays."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Correspondence:
    """What a view shows where points (..., 3) project.

    Attributes:
        surface_m: (..., 3) the observed point in the camera frame.
        normal: (..., 3), zero where unknown.
        measured: (...) whether there is one.
        unexplained: (...) whether it waits for an object.
    """

    surface_m: jax.Array
    normal: jax.Array
    measured: jax.Array
    unexplained: jax.Array


def look_up(view: DepthView, points_m: jax.Array) -> Correspondence:
    """The observed points onto which points (..., 3) project."""
    height, width = view.depth_m.shape
    camera = view.camera
    z = jnp.maximum(points_m[..., 2], 1e-3)
    u = jnp.round(camera.fx * points_m[..., 0] / z + camera.cx).astype(jnp.int32)
    v = jnp.round(camera.fy * points_m[..., 1] / z + camera.cy).astype(jnp.int32)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height) & (points_m[..., 2] > 1e-3)
    place = jnp.clip(v, 0, height - 1) * width + jnp.clip(u, 0, width - 1)
    depth = view.depth_m.reshape(-1)[place]
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return Correspondence(
        surface_m=jnp.stack([x * depth, y * depth, depth], axis=-1),
        normal=view.normals.reshape(-1, 3)[place],
        measured=inside & (depth > 0),
        unexplained=view.unexplained.reshape(-1)[place],
    )


def seen(points_m: jax.Array, normals: jax.Array) -> jax.Array:
    """Which surface points (..., P, 3) face the camera at the origin."""
    cosine = jnp.sum(points_m * normals, axis=-1) / jnp.linalg.norm(points_m, axis=-1)
    return cosine < GRAZING


@partial(jax.jit, static_argnames="iterations")
def align(
    view: DepthView,
    points_m: jax.Array,
    normals: jax.Array,
    visible: jax.Array,
    poses: jax.Array,
    first_m: float,
    last_m: float,
    iterations: int,
) -> jax.Array:
    """Poses (K, 7) camera_from_box after point-to-plane ICP with projective correspondences.

    Each point takes the depth pixel onto which it falls; Geman-McClure weights narrow from `first_m` to
    `last_m`.

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
        arms = jnp.sum(rotation[None] * points_m[:, None], axis=-1)
        outward = jnp.sum(rotation[None] * normals[:, None], axis=-1)
        placed = arms + pose[4:][None]
        observed = look_up(view, placed)
        residual = jnp.sum(outward * (observed.surface_m - placed), axis=-1)
        agree = jnp.sum(observed.normal * outward, axis=-1) > 0.3
        near = jnp.abs(observed.surface_m[:, 2] - placed[:, 2]) < 4 * scale
        use = shown & observed.measured & observed.unexplained & agree & near & seen(placed, outward)
        weight = jnp.where(use, (1 + (residual / scale) ** 2) ** -2, 0.0)
        rows = jnp.concatenate([outward, jnp.cross(arms, outward)], axis=1)
        matrix = (weight[:, None] * rows).T @ rows + jnp.diag(jnp.asarray(DAMPING))
        step = jnp.linalg.solve(matrix, rows.T @ (weight * residual))
        turned = jaxlie.SO3.exp(step[3:]) @ jaxlie.SO3(pose[:4])
        return jnp.concatenate([turned.normalize().wxyz, pose[4:] + step[:3]])

    def narrow(poses: jax.Array, scale: jax.Array) -> tuple[jax.Array, None]:
        return jax.vmap(improve, in_axes=(0, None, 0))(poses, scale, visible), None

    return jax.lax.scan(narrow, poses, scales)[0]
