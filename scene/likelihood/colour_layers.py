"""What the colours of a frame say of objects in poses: a factor beside that of its depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from scene.execution import FAST_COMPILE
from scene.likelihood.colour_density import ANY_SD, GAIN_SD, SURFACE_SD, ColourDensity, window_colours
from scene.likelihood.pixel_density import PixelDensity
from scene.objects.scene_object import SceneObject
from scene.objects.surface_colour import SPINS
from scene.observation.frame_data import SceneData
from shapes.geometry.camera import Camera, pixel_rays
from shapes.geometry.poses import matrices_of, poses_of

COMPARED = 384
"""Pixels of a layer, drawn at random, by which turns are compared in the search: a label is many of them."""
CROPS = (40, 40), (84, 112)
"""Pixels of crops that hold an object and a pixel beside it; what fits none is not cut. All that comes before
a pixel tells of an object's light, so that tiles would not do."""
STRANGE = 3.0
"""Standard deviations from which a pixel tells no more of a turn: what hides the surface."""


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
        origin_m, last = (
            jnp.broadcast_to(part, points_m.shape) for part in (self.origin_m[one], self.size[one] - 1)
        )
        cell = jnp.floor((points_m - origin_m) / self.pitch_m[one]).astype(jnp.int32)
        x, y, z = jnp.moveaxis(jnp.clip(cell, 0, last), -1, 0)
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
    """

    density: ColourDensity
    depth_density: PixelDensity
    tables: ColourTables
    camera: Camera

    @classmethod
    def of(
        cls, data: SceneData, objects: Sequence[SceneObject], depth_density: PixelDensity, gamma: float
    ) -> ColourLayers | None:
        """Those of a frame; None where its colours are not compared."""
        if data.rgb is None:
            return None
        density = ColourDensity.of(*window_colours(data.rgb, data.rgb_known, data.window, gamma))
        return cls(density, depth_density, ColourTables.of(objects), data.window.camera)

    def of_objects(self, objects: Sequence[SceneObject]) -> ColourLayers:
        """The same frame, with other objects."""
        return replace(self, tables=ColourTables.of(objects))

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
        return _log_factors_alone(self, np.asarray(numbers, np.int32), cameras_from_box, depth_m)

    def turned(
        self,
        objects: Sequence[SceneObject],
        numbers: NDArray[np.integer],
        poses: NDArray[np.floating],
        depth_m: NDArray[np.float32],
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """The poses (n, 7), each after that turn which leaves the shape as it is and suits its colours best.

        And log shares (n,): of what is round any spin fits the depth, and the colours one of so many.
        """
        turned, log_shares = np.array(poses, np.float64), np.zeros(len(poses))
        for one in np.unique(numbers):
            colour, mine = objects[one].colour, np.flatnonzero(numbers == one)
            if colour is None or len(colour.looks) == 1:
                continue
            before = matrices_of(turned[mine])
            turns, cameras = colour.looks.astype(np.float32), before.astype(np.float32)
            best = np.asarray(_best_turns(self, np.int32(one), turns, cameras, depth_m[mine]))
            turned[mine] = poses_of(before @ colour.looks[best])
            log_shares[mine] = -np.log(min(len(colour.looks), SPINS)) if colour.spins else 0.0
        return turned.astype(np.float32), log_shares

    def log_factors_of_turns(
        self,
        one: int,
        turns: NDArray[np.float64],
        pose: NDArray[np.floating],
        layer_m: NDArray[np.float32],
    ) -> NDArray[np.float64]:
        """Sums (T,) over the window of an object's factors, after turns (T, 4, 4).

        Args:
            one: number of the object.
            turns: that leave its shape as it is.
            pose: (7,) camera_from_box before the turn.
            layer_m: (H, W) depth of the object alone.
        """
        cameras_from_box = (matrices_of(np.asarray(pose, np.float64)) @ turns).astype(np.float32)
        return np.asarray(_sums_of_turns(self, np.int32(one), cameras_from_box, layer_m), np.float64)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ComparedColours:
    """Colours as one more factor of the density of depth images.

    Attributes:
        layers: of one of the frames, and of the objects.
        weight: exponent of the factor.
        frame: number of the frame.
    """

    layers: ColourLayers
    weight: jax.Array
    frame: int = field(metadata={"static": True})

    def log_factors(
        self, frames: jax.Array, objects: jax.Array, poses: jax.Array, layers_m: jax.Array
    ) -> jax.Array:
        """Logs (n, H, W) of what objects (n,) at poses (n, 7) camera_from_box bring to frames (n,).

        Their layers are (n, H, W), +inf beside them; other frames than the one with colours get 0.
        """
        cameras_from_box = jax.vmap(lambda pose: jaxlie.SE3(pose).as_matrix())(poses)
        mine = jnp.where((frames == self.frame)[:, None, None], layers_m, jnp.inf)
        return self.weight * _log_factors(self.layers, objects, cameras_from_box, mine)


def _in_box(camera: Camera, camera_from_box: jax.Array, layer_m: jax.Array) -> jax.Array:
    """Points (H, W, 3) of a layer (H, W), in the frame of the box at a pose (4, 4)."""
    depth_m = jnp.where(jnp.isfinite(layer_m), layer_m, 1.0)
    rays = pixel_rays(camera, *layer_m.shape)
    return (rays * depth_m[..., None] - camera_from_box[None, None, :3, 3]) @ camera_from_box[:3, :3]


def _log_factors(
    layers: ColourLayers, numbers: jax.Array, cameras_from_box: jax.Array, depth_m: jax.Array
) -> jax.Array:
    """Logs (n, H, W) of layers (n, H, W), one after the other: each in the smallest crop that holds it."""
    size = depth_m.shape[1:]
    crops = [*[crop for crop in CROPS if crop[0] < size[0] and crop[1] < size[1]], size]

    def factor(part: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        _, _, layer_m = part
        covered = jnp.isfinite(layer_m)
        (top, below), (left, right) = (_lines_around(jnp.any(covered, axis=axis)) for axis in (1, 0))
        number = jnp.int32(0)
        for rows, columns in crops[:-1]:
            number += (below - top > rows) | (right - left > columns)
        shows = layers.depth_density.shown_by(layer_m)
        ways = [partial(_in_crop, layers, crop) for crop in crops]
        return jax.lax.cond(
            below > 0,
            lambda: jax.lax.switch(number, ways, *part, shows, top, left),
            lambda: jnp.zeros_like(layer_m),
        )

    return jax.lax.map(factor, (numbers, cameras_from_box, depth_m))


_log_factors_alone = jax.jit(_log_factors, compiler_options=FAST_COMPILE)


def _in_crop(
    layers: ColourLayers,
    crop: tuple[int, int],
    one: jax.Array,
    camera_from_box: jax.Array,
    layer_m: jax.Array,
    shows: jax.Array,
    top: jax.Array,
    left: jax.Array,
) -> jax.Array:
    """Logs (H, W) of a layer, in a crop from (top, left) on; pixels show it with probability (H, W)."""
    rows, columns = crop
    start = jnp.minimum(top, layer_m.shape[0] - rows), jnp.minimum(left, layer_m.shape[1] - columns)
    camera = replace(layers.camera, cx=layers.camera.cx - start[1], cy=layers.camera.cy - start[0])
    nothing = jnp.zeros_like(layer_m)
    layer_m, shows = (jax.lax.dynamic_slice(part, start, crop) for part in (layer_m, shows))
    model = layers.tables.at(one, _in_box(camera, camera_from_box, layer_m))
    factors = layers.density.cut(start, crop).log_factor(model, shows, layers.tables.gain_sd[one])
    return jax.lax.dynamic_update_slice(nothing, factors, start)


def _lines_around(covered: jax.Array) -> tuple[jax.Array, jax.Array]:
    """First line (...) of what is covered (..., lines) and of one beside it, and the line after the last.

    That is 0 where nothing is covered.
    """
    lines = covered.shape[-1]
    first = jnp.maximum(jnp.argmax(covered, axis=-1) - 1, 0)
    after = jnp.minimum(lines - jnp.argmax(covered[..., ::-1], axis=-1) + 1, lines)
    there = jnp.any(covered, axis=-1)
    return first.astype(jnp.int32), jnp.where(there, after, 0).astype(jnp.int32)


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _sums_of_turns(
    layers: ColourLayers, one: jax.Array, cameras_from_box: jax.Array, layer_m: jax.Array
) -> jax.Array:
    shows = layers.depth_density.shown_by(layer_m)

    def of_turn(camera_from_box: jax.Array) -> jax.Array:
        model = layers.tables.at(one, _in_box(layers.camera, camera_from_box, layer_m))
        return jnp.sum(layers.density.log_factor(model, shows, layers.tables.gain_sd[one]))

    return jax.lax.map(of_turn, cameras_from_box)


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _best_turns(
    layers: ColourLayers, one: jax.Array, turns: jax.Array, cameras_from_box: jax.Array, depth_m: jax.Array
) -> jax.Array:
    """The turn (n,) that leaves the least of `COMPARED` pixels' residuals about their common gain."""
    order = jax.random.uniform(jax.random.key(0), depth_m.shape[1:])
    gain_sd, surface_sd = layers.tables.gain_sd[one], jnp.asarray(SURFACE_SD)

    def best(part: tuple[jax.Array, jax.Array]) -> jax.Array:
        camera_from_box, layer_m = part
        shows = jnp.where(layers.density.known, layers.depth_density.shown_by(layer_m), 0.0)
        _, places = jax.lax.top_k(jnp.where(shows > 0, order, -1.0).ravel(), min(COMPARED, shows.size))
        weights = shows.ravel()[places][:, None] / surface_sd[None] ** 2
        points_m = _in_box(layers.camera, camera_from_box, layer_m).reshape(-1, 3)[places]
        observed = layers.density.observed.reshape(-1, 3)[places]

        def misfit(turn: jax.Array) -> jax.Array:
            residual = observed - layers.tables.at(one, (points_m - turn[None, :3, 3]) @ turn[:3, :3])
            gain = jnp.sum(weights * residual, axis=0) / (gain_sd**-2.0 + jnp.sum(weights, axis=0))
            squares = jnp.sum(weights * (residual - gain[None]) ** 2, axis=1)
            return jnp.sum(jnp.minimum(squares, STRANGE**2)) + jnp.sum((gain / gain_sd) ** 2)

        return jnp.argmin(jax.lax.map(misfit, turns))

    return jax.lax.map(best, (cameras_from_box, depth_m))
