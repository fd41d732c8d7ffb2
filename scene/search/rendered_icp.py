"""ICP of the rendered visible clouds of a whole scene: the last step of the search."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from scene.execution import FAST_COMPILE
from scene.likelihood.object_renderer import ObjectRenderer
from scene.objects.scene_object import SceneObject
from scene.observation.depth_view import PooledView
from scene.observation.frame_data import SceneData
from scene.search.icp import ViewTable, align, look_up, rotated
from shapes.geometry.camera import Camera
from shapes.stored_kernels import jit_stored

ROUNDS, ITERATIONS = 4, 6
"""Renderings of the scene, and iterations of ICP after each. Search effort."""

FIRST_M, LAST_M = 0.006, 0.002
"""Scales of the residuals in a round, first and last."""

SELF_OCCLUSION_M = 0.008
"""A surface point that lies further behind what is rendered round its pixel is hidden."""


def refine_in_render(
    data: SceneData,
    objects: Sequence[SceneObject],
    renderer: ObjectRenderer,
    poses: NDArray[np.floating],
    present: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Poses (N, 7) after ICP of what the scene shows of each object, rendered anew in an outer loop."""
    points = np.stack([one.points_m for one in objects])
    normals = np.stack([one.normals for one in objects])
    current = np.asarray(poses, np.float32)
    for _ in range(ROUNDS):
        depth = renderer.layers(np.arange(len(objects)), current, data.window)
        depth = np.where(present[:, None, None], depth, np.inf)
        current = np.asarray(
            _polished_once(data.view, points, normals, current, data.window.camera, depth.min(axis=0))
        )
    return current


@jit_stored(compiler_options=FAST_COMPILE)
def _polished_once(
    view: PooledView,
    points_m: jax.Array,
    normals: jax.Array,
    poses: jax.Array,
    camera: Camera,
    scene_m: jax.Array,
) -> jax.Array:
    """One round: a point takes part if the rendered scene (H, W) does not hide it."""
    table = ViewTable.of(view)
    around = jax.lax.reduce_window(scene_m, -jnp.inf, jax.lax.max, (3, 3), (1, 1), "SAME")
    around = jnp.where(jnp.isfinite(around), around, 0.0)
    scene = ViewTable(camera, around.reshape(-1), jnp.zeros(around.size, jnp.int32), *around.shape)

    def one(points_m: jax.Array, normals: jax.Array, pose: jax.Array) -> jax.Array:
        turned = rotated(jaxlie.SO3(pose[:4]).as_matrix(), points_m)
        placed = [turned[axis] + pose[4 + axis] for axis in range(3)]
        front = look_up(scene, placed)
        visible = ~front.measured | (placed[2] < front.depth_m + SELF_OCCLUSION_M)
        improve = partial(align, first_m=FIRST_M, last_m=LAST_M, iterations=ITERATIONS)
        return improve(table, points_m, normals, visible[None], pose[None])[0]

    return jax.vmap(one)(points_m, normals, poses)
