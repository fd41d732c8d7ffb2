"""Depth layers of scene objects in windows, through one library."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from scene.execution import map_parallel
from scene.objects.scene_object import SceneObject
from scene.objects.slots import OUT_OF_SIGHT
from scene.observation.pixel_window import PixelWindow
from shapes.geometry.camera import Camera
from shapes.rendering.depth_rendering import render_layers
from shapes.rendering.object_library import ObjectLibrary, join
from shapes.rendering.ray_casting import PosedObjects
from shapes.stored_kernels import jit_stored

LAYERS = 64
"""Rendered in one kernel; kernels run side by side, each on a core."""
OBJECTS = 8
"""Libraries hold a multiple of so many, so that few kernels are compiled."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ObjectRenderer:
    """The objects' library.

    Attributes:
        library: N objects, in their boxes' frames, or one draw of all after another; then what fills up.
        draws: of each object's shape.
    """

    library: ObjectLibrary
    draws: int = field(default=1, metadata={"static": True})

    @classmethod
    def of(cls, objects: Sequence[SceneObject]) -> ObjectRenderer:
        """The renderer of these objects, in order."""
        return cls(_joined([one.library for one in objects]))

    @classmethod
    def of_draws(cls, objects: Sequence[SceneObject]) -> ObjectRenderer:
        """The renderer of all draws of these objects' shapes: the first of each object, the second, ..."""
        draws = list(zip(*[one.draws or (one.library,) for one in objects], strict=True))
        return cls(_joined([library for draw in draws for library in draw]), len(draws))

    def compile(self, window: PixelWindow) -> None:
        """What `layers` runs."""
        nowhere = np.tile(np.asarray(OUT_OF_SIGHT, np.float32), (LAYERS, 1))
        _layers.lower(
            self,
            window.camera,
            *window.depth_m.shape,
            np.zeros(LAYERS, np.int32),
            nowhere,
            np.ones((LAYERS, 3), np.float32),
        ).compile()

    def layers(
        self,
        indices: NDArray[np.integer],
        poses: NDArray[np.floating],
        window: PixelWindow,
        scales: NDArray[np.floating] | None = None,
    ) -> NDArray[np.float32]:
        """Depth (n, H, W) of n objects alone in a window.

        `LAYERS` in a kernel, so that one kernel serves any number.

        Args:
            indices: (n,) of the objects.
            poses: (n, 7) camera_from_box.
            window: the pixels.
            scales: (n, 3) by which objects are larger along the axes of their boxes, about their centres;
                None: as they are.
        """
        if not len(indices):
            return np.zeros((0, *window.depth_m.shape), np.float32)
        parts = -(-len(indices) // LAYERS)
        every = np.tile(np.asarray(OUT_OF_SIGHT, np.float32), (parts * LAYERS, 1))
        every[: len(poses)] = poses
        which = np.resize(np.asarray(indices, np.int32), parts * LAYERS)
        scales = np.ones((1, 3)) if scales is None else scales
        given = which, every, np.resize(np.asarray(scales, np.float32), (parts * LAYERS, 3))

        def rendered(part: tuple[NDArray, ...]) -> NDArray[np.float32]:
            return np.asarray(_layers(self, window.camera, *window.depth_m.shape, *part))

        depth = map_parallel(rendered, zip(*(np.split(leaf, parts) for leaf in given), strict=True))
        return np.concatenate(depth)[: len(indices)]

    def posed(
        self,
        indices: jax.Array,
        poses: jax.Array,
        camera_index: jax.Array,
        scales: jax.Array | None = None,
    ) -> PosedObjects:
        """Objects at poses (n, 7) camera_from_box, of scales (n, 3), as the engine takes them."""
        matrices = jax.vmap(lambda pose: jaxlie.SE3(pose).as_matrix())(poses.astype(jnp.float32))
        return PosedObjects(indices.astype(jnp.int32), matrices, camera_index.astype(jnp.int32), scales)


def _joined(libraries: Sequence[ObjectLibrary]) -> ObjectLibrary:
    """One library, filled up to a multiple of `OBJECTS` with its last."""
    library = join(libraries)
    filled = np.minimum(np.arange(-(-len(library) // OBJECTS) * OBJECTS), len(library) - 1)
    columns = replace(library, table=library.first_voxel)
    columns = jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[filled], columns))
    return replace(columns, table=library.table)


@jit_stored(static_argnames=("height", "width"))
def _layers(
    renderer: ObjectRenderer,
    camera: Camera,
    height: int,
    width: int,
    indices: jax.Array,
    poses: jax.Array,
    scales: jax.Array,
) -> jax.Array:
    posed = renderer.posed(indices, poses, jnp.zeros(len(indices), jnp.int32), scales)
    cameras = jax.tree.map(lambda leaf: leaf[None], camera)
    return render_layers(renderer.library, posed, cameras, height, width)
