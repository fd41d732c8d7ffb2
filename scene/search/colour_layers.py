"""What the colours of a frame say of objects in poses: a factor beside that of its depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from scene.execution import FAST_COMPILE
from scene.likelihood.colour_density import ANY_SD, GAIN_SD, ColourDensity, window_colours
from scene.likelihood.pixel_density import PixelDensity
from scene.objects.scene_object import SceneObject
from scene.objects.surface_colour import SPINS
from scene.observation.frame_data import SceneData
from shapes.geometry.camera import Camera
from shapes.geometry.poses import matrices_of, poses_of

SKIPPED = 2
"""Of so many rows and columns of the window one is looked at when turns are compared."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ColourTables:
    """Colours along the surfaces of N objects, in their box frames.

    Attributes:
        values: (M, 3) of all voxels, object after object.
        first: (N,) where each object's voxels start.
        size: (N, 3) voxels per axis.
        origin_m: (N, 3) corner of voxel (0, 0, 0).
        pitch_m: (N,).
        gain_sd: (N, 3) of their light.
    """

    values: jax.Array
    first: jax.Array
    size: jax.Array
    origin_m: jax.Array
    pitch_m: jax.Array
    gain_sd: jax.Array

    @classmethod
    def of(cls, objects: Sequence[SceneObject]) -> ColourTables:
        """Those of objects, in order; what has a colour that nobody knows may have any."""
        colours = [one.colour for one in objects if one.colour is not None]
        counts = [one.values[..., 0].size for one in colours]
        known = np.array([one.is_known for one in colours])
        arrays = (
            np.concatenate([one.values.reshape(-1, 3) for one in colours]),
            np.cumsum([0, *counts[:-1]]).astype(np.int32),
            np.array([one.values.shape[:3] for one in colours], np.int32),
            np.array([one.origin_m for one in colours], np.float32),
            np.array([one.pitch_m for one in colours], np.float32),
            np.where(known[:, None], GAIN_SD, ANY_SD).astype(np.float32),
        )
        return cls(*map(jax.device_put, arrays))

    def at(self, one: jax.Array, points_m: jax.Array) -> jax.Array:
        """Colours (..., 3) of points (..., 3) in an object's box frame."""
        cell = jnp.floor((points_m - self.origin_m[one]) / self.pitch_m[one]).astype(jnp.int32)
        x, y, z = jnp.moveaxis(jnp.clip(cell, 0, self.size[one] - 1), -1, 0)
        return self.values[self.first[one] + (x * self.size[one][1] + y) * self.size[one][2] + z]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ColourLayers:
    """The colours of one frame's window and of all objects.

    Attributes:
        density: of the colours.
        depth_density: of the window's depth, which tells what pixels show.
        tables: of the objects.
        camera: of the window.
        coarse: the density of every `SKIPPED`-th row and column of the window.
    """

    density: ColourDensity
    depth_density: PixelDensity
    tables: ColourTables
    camera: Camera
    coarse: ColourDensity

    @classmethod
    def of(
        cls, data: SceneData, objects: Sequence[SceneObject], depth_density: PixelDensity, gamma: float
    ) -> ColourLayers:
        """Those of a frame.

        Raises:
            ValueError: it has no colours.
        """
        if data.rgb is None:
            raise ValueError("the frame has no colours")
        observed, known = window_colours(data.rgb, data.rgb_known, data.window, gamma)
        density = ColourDensity.of(observed, known)
        return cls(
            density=density,
            depth_density=depth_density,
            tables=ColourTables.of(objects),
            camera=data.window.camera,
            coarse=ColourDensity.of(observed[::SKIPPED, ::SKIPPED], known[::SKIPPED, ::SKIPPED]),
        )

    def log_factors(
        self, numbers: NDArray[np.integer], poses: NDArray[np.floating], depth_m: NDArray[np.float32]
    ) -> jax.Array:
        """Logs (n, H, W) of what objects `numbers` (n,) at poses (n, 7) bring where they are seen.

        Args:
            numbers: of the objects.
            poses: camera_from_box.
            depth_m: (n, H, W) of each alone, +inf beside it.
        """
        cameras_from_box = matrices_of(np.asarray(poses, np.float64)).astype(np.float32)
        return _log_factors(self, np.asarray(numbers, np.int32), cameras_from_box, depth_m)

    def turned(
        self,
        objects: Sequence[SceneObject],
        numbers: NDArray[np.integer],
        poses: NDArray[np.floating],
        depth_m: NDArray[np.float32],
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """The poses (n, 7), each after that turn which leaves the shape as it is and suits its colours best.

        And log shares (n,): of what is round any spin fits the depth, of which colours leave such a share.
        """
        turned, log_shares = np.array(poses, np.float64), np.zeros(len(poses))
        for one in np.unique(numbers):
            colour, mine = objects[one].colour, np.flatnonzero(numbers == one)
            if colour is not None and len(colour.turns) > 1:
                sums = self.log_factors_of_turns(int(one), colour.turns, turned[mine], depth_m[mine])
                best = colour.turns[sums.argmax(axis=1)]
                turned[mine] = poses_of(matrices_of(turned[mine]) @ best)
                if colour.spins:
                    fitting = np.exp(sums - sums.max(axis=1, keepdims=True)).sum(axis=1)
                    log_shares[mine] = np.minimum(np.log(fitting / SPINS), 0.0)
        return turned.astype(np.float32), log_shares

    def log_factors_of_turns(
        self,
        one: int,
        turns: NDArray[np.float64],
        poses: NDArray[np.floating],
        depth_m: NDArray[np.float32],
    ) -> NDArray[np.float64]:
        """Sums (n, T) over every `SKIPPED`-th row and column of an object's factors, after turns (T, 4, 4).

        Args:
            one: number of the object.
            turns: that leave its shape as it is.
            poses: (n, 7) camera_from_box before the turn.
            depth_m: (n, H, W).
        """
        cameras_from_box = matrices_of(np.asarray(poses, np.float64))[:, None] @ turns
        sums = _sums_of_turns(self, np.int32(one), cameras_from_box.astype(np.float32), depth_m)
        return np.asarray(sums, np.float64)


def _model(
    layers: ColourLayers, one: jax.Array, camera_from_box: jax.Array, depth_m: jax.Array, step: int
) -> jax.Array:
    """Colours of an object at a pose (4, 4) in every `step`-th row and column of its layer (H, W)."""
    camera = layers.camera
    height, width = depth_m.shape
    columns, rows = jnp.meshgrid(jnp.arange(0, width, step), jnp.arange(0, height, step))
    finite_m = jnp.where(jnp.isfinite(depth_m), depth_m, 1.0)[::step, ::step]
    rays = [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, jnp.ones_like(finite_m)]
    points_m = jnp.stack(rays, axis=-1) * finite_m[..., None] - camera_from_box[:3, 3]
    return layers.tables.at(one, points_m @ camera_from_box[:3, :3])


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _log_factors(
    layers: ColourLayers, numbers: jax.Array, cameras_from_box: jax.Array, depth_m: jax.Array
) -> jax.Array:
    def factor(part: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        one, camera_from_box, layer_m = part
        model, shows = (
            _model(layers, one, camera_from_box, layer_m, 1),
            layers.depth_density.shown_by(layer_m),
        )
        return layers.density.log_factor(model, shows, layers.tables.gain_sd[one])

    return jax.lax.map(factor, (numbers, cameras_from_box, depth_m))


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _sums_of_turns(
    layers: ColourLayers, one: jax.Array, cameras_from_box: jax.Array, depth_m: jax.Array
) -> jax.Array:
    def sums(part: tuple[jax.Array, jax.Array]) -> jax.Array:
        turned, layer_m = part
        shows = layers.depth_density.shown_by(layer_m)[::SKIPPED, ::SKIPPED]

        def of_turn(camera_from_box: jax.Array) -> jax.Array:
            model = _model(layers, one, camera_from_box, layer_m, SKIPPED)
            return jnp.sum(layers.coarse.log_factor(model, shows, layers.tables.gain_sd[one]))

        return jax.lax.map(of_turn, turned)

    return jax.lax.map(sums, (cameras_from_box, depth_m))
