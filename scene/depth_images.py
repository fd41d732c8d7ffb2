"""The likelihood of whole scenes in chains: depth images in which the nearest surface is seen.

A chain keeps what each object shows, cut into tiles, and the log density of every tile, so that a move
costs the tiles that the moved object covers and no others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.custom_batching import custom_vmap
from numpy.typing import NDArray

from recordings.types import DepthNoise
from scene import shape_choices
from scene.graph import SceneGraph
from scene.model import MOST_MOVED, Estimate
from scene.poses import pose_of
from scene.rendering import OUT_OF_SIGHT, ObjectRenderer
from scene.scene_data import SceneData
from shapes import depth_noise
from shapes.camera import Camera
from shapes.depth_rendering import render_tiles
from shapes.ray_casting import chosen_first
from shapes.tile_queue import for_each_block
from shapes.tiles import TILE_PIXELS, tiled

TILES_TOGETHER = 64


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ShownScene:
    """What a scene shows in the X tiles of all frames, for each of R draws of the objects' shapes.

    Attributes:
        shapes: (R, N) int32, which of its known shapes each object has.
        layers_m: (R, N, X, TILE_PIXELS) float32, depth of each object alone, +inf where it is not seen.
        log_tiles: (R, X) float32, log density of each tile.
    """

    shapes: jax.Array
    layers_m: jax.Array
    log_tiles: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DepthImages:
    """prod over frames and pixels of the sensor's density, to the power `weights`.

    Neighbouring pixels share their error, of the sensor and of the shape, so that a pixel is worth less
    than an independent measurement: the weight is the effective number of pixels over their number.
    What is neither an object nor the table is taken as it was seen. Objects are bodies 0..N-1.

    Where an object's shape is not certain, `renderer` holds S draws of every object's shape, draw after
    draw, and the likelihood is the mean over R independent choices among them: an unbiased estimate of
    the likelihood with the shapes summed out (supplement N). A moved object's choices, or a share of them,
    are made anew, the others' stay part of the chain's state (Tran et al. 2016, block pseudo-marginal).

    Attributes:
        renderer: S N shapes.
        cameras: leaves (F,), of the windows.
        camera_from_world: (F, 7).
        observed_m: (X, TILE_PIXELS) float32, the tiles of all frames.
        rest_m: the same, the background's depth; 0 for pixels beyond the image, which do not count.
        weights: (F,) exponents.
        noise: of the sensor and the surfaces together.
        objects: N.
        height, width: of the windows.
        fresh_share: how many of the choices a new estimate makes anew.
        draws: R.
    """

    depends_on_graph: ClassVar[bool] = False
    renderer: ObjectRenderer
    cameras: Camera
    camera_from_world: jax.Array
    observed_m: jax.Array
    rest_m: jax.Array
    weights: jax.Array
    noise: DepthNoise
    fresh_share: jax.Array
    objects: int = field(metadata={"static": True})
    height: int = field(metadata={"static": True})
    width: int = field(metadata={"static": True})
    draws: int = field(default=1, metadata={"static": True})

    @classmethod
    def of(
        cls,
        views: Sequence[SceneData],
        camera_from_world: NDArray[np.float64],
        renderer: ObjectRenderer,
        noise: DepthNoise,
        pixel_weight: float,
        *,
        objects: int,
        draws: int = 1,
    ) -> DepthImages:
        """The likelihood of the frames `views` from poses (F, 4, 4).

        A finer window has more pixels of the same image and not more information: `pixel_weight` counts
        the pixels of the search's window.
        """
        rest_m = [np.where(view.detail.inside, view.detail_rest_m, 0) for view in views]
        shares = [(view.detail.stride / view.window.stride) ** 2 for view in views]
        height, width = rest_m[0].shape
        return cls(
            renderer=renderer,
            cameras=jax.tree.map(lambda *leaves: jnp.stack(leaves), *[view.detail.camera for view in views]),
            camera_from_world=jax.vmap(pose_of)(jnp.asarray(camera_from_world)),
            observed_m=tiled(jnp.asarray(np.stack([view.detail.depth_m for view in views])), 0.0),
            rest_m=tiled(jnp.asarray(np.stack(rest_m), jnp.float32), 0.0),
            weights=pixel_weight * jnp.asarray(shares),
            noise=jax.tree.map(jnp.float32, noise),
            fresh_share=jnp.ones(()),
            objects=objects,
            height=height,
            width=width,
            draws=draws,
        )

    def start(self, key: jax.Array, scene: SceneGraph) -> Estimate:
        """Shapes are drawn, nothing is rendered."""
        tiles = len(self.observed_m)
        layers_m = jnp.full((self.draws, self.objects, tiles, TILE_PIXELS), jnp.inf, jnp.float32)
        log_tiles = jnp.zeros((self.draws, tiles), jnp.float32)
        shapes = shape_choices.drawn(key, (self.draws, self.objects), self._known)
        shown = ShownScene(shapes, layers_m, log_tiles)
        return Estimate(jnp.zeros((), scene.poses.dtype), shown)

    def update(
        self, keys: jax.Array, scene: SceneGraph, moved: jax.Array, current: Estimate, *, anew: jax.Array
    ) -> Estimate:
        """The layers of what moved, or all of them, rendered; the log densities of what changed."""
        before: ShownScene = current.draws
        moved, rendered = (mask[: self.objects] for mask in (moved, moved | anew))
        shapes = jnp.where(moved[None], self._redrawn(keys, before.shapes), before.shapes)
        seen = self._seen(scene.poses[: self.objects])
        together = min(MOST_MOVED, self.objects)
        turns = -(-self.objects // together)
        order = jnp.nonzero(rendered, size=turns * together, fill_value=self.objects)[0]

        def some(turn: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            layers_m, changed = state
            which = jax.lax.dynamic_slice_in_dim(order, turn * together, together)
            one = jnp.minimum(which, self.objects - 1)
            aside = jnp.asarray(OUT_OF_SIGHT, jnp.float32)
            there = jnp.where((which < self.objects)[:, None, None], seen[one], aside[None, None])
            fresh_m = _layers(self, shapes[:, one] * self.objects + one[None], there)
            changed |= jnp.any(_covered(fresh_m) | _covered(layers_m[:, one]), axis=1)
            return layers_m.at[:, which].set(fresh_m, mode="drop"), changed

        state = before.layers_m, jnp.broadcast_to(anew, before.log_tiles.shape)
        layers_m, changed = jax.lax.fori_loop(0, jnp.where(anew, turns, 1), some, state)
        shown = self._weighed(ShownScene(shapes, layers_m, before.log_tiles), scene.present, changed)
        return Estimate(_log_mean_exp(self._log_each(shown.log_tiles)), shown)

    def of_candidates(
        self, keys: jax.Array, scene: SceneGraph, chosen: jax.Array, poses: jax.Array, current: Estimate
    ) -> jax.Array:
        """Only what each pose covers is looked at; the rest of the scene is the same for all."""
        shown: ShownScene = current.draws
        others = scene.present & (jnp.arange(len(scene.present)) != chosen)
        rest = self._weighed(shown, others, _covered(shown.layers_m[:, chosen]))
        shapes = jax.vmap(self._redrawn, in_axes=(0, None))(keys, shown.shapes)
        shapes = shapes[:, :, chosen].at[0].set(shown.shapes[:, chosen])
        gains = _gains(
            self,
            shapes * self.objects + chosen,
            self._seen(poses),
            others[: self.objects],
            shown.layers_m,
            rest.log_tiles,
        )
        log_gains = jnp.sum(self.weights[None, None] * gains.astype(poses.dtype), axis=-1)
        return _log_mean_exp(self._log_each(rest.log_tiles)[None] + log_gains)

    @property
    def _known(self) -> int:
        """S."""
        return len(self.renderer.library) // self.objects

    def _redrawn(self, keys: jax.Array, shapes: jax.Array) -> jax.Array:
        if self._known == 1:
            return shapes
        return shape_choices.redrawn(keys, shapes, self._known, self.fresh_share)

    def _weighed(self, shown: ShownScene, present: jax.Array, changed: jax.Array) -> ShownScene:
        """The log densities of the changed tiles (R, X) brought up to date."""

        def one(layers_m: jax.Array, log_tiles: jax.Array, changed: jax.Array) -> jax.Array:
            order, count = chosen_first(changed)

            def some(turn: jax.Array, log_tiles: jax.Array) -> jax.Array:
                mine = jax.lax.dynamic_slice_in_dim(order, turn * TILES_TOGETHER, TILES_TOGETHER)
                there = turn * TILES_TOGETHER + jnp.arange(TILES_TOGETHER, dtype=jnp.int32) < count
                use = present[: self.objects][:, None, None]
                depth_m = jnp.min(jnp.where(use, layers_m[:, mine], jnp.inf), axis=0)
                log_mine = self._log_density(mine, jnp.minimum(depth_m, self.rest_m[mine]))
                return log_tiles.at[jnp.where(there, mine, len(log_tiles))].set(log_mine, mode="drop")

            return jax.lax.fori_loop(0, -(-count // TILES_TOGETHER), some, log_tiles)

        log_tiles = jax.vmap(one)(shown.layers_m, shown.log_tiles, changed)
        return ShownScene(shown.shapes, shown.layers_m, log_tiles)

    def _log_density(self, tile: jax.Array, shown_m: jax.Array) -> jax.Array:
        """Log density (B,) of tiles (B,) that show depths (B, TILE_PIXELS), exponent 1."""
        log_pixels = depth_noise.log_density(self.noise, self.observed_m[tile], shown_m)
        return jnp.sum(jnp.where(self.rest_m[tile] > 0, log_pixels, 0), axis=1, dtype=jnp.float32)

    def _log_each(self, log_tiles: jax.Array) -> jax.Array:
        """Log likelihood (R,) under each draw."""
        by_frame = log_tiles.reshape(len(log_tiles), len(self.weights), -1)
        return jnp.sum(self.weights[None] * jnp.sum(by_frame, axis=2, dtype=self.weights.dtype), axis=1)

    def _seen(self, poses: jax.Array) -> jax.Array:
        """Poses (n, F, 7) float32 in every camera of poses (n, 7) in the world."""

        def in_camera(camera: jax.Array, pose: jax.Array) -> jax.Array:
            return (jaxlie.SE3(camera) @ jaxlie.SE3(pose)).wxyz_xyz

        in_cameras = jax.vmap(jax.vmap(in_camera, in_axes=(0, None)), in_axes=(None, 0))
        return in_cameras(self.camera_from_world, poses).astype(jnp.float32)


@partial(jax.jit, static_argnames="count")
def log_estimates(key: jax.Array, likelihood: DepthImages, scenes: SceneGraph, count: int) -> jax.Array:
    """Estimates (count, B) of the log likelihood of each of B scenes, all shapes drawn anew for each."""

    def one(key: jax.Array, scene: SceneGraph) -> jax.Array:
        start_key, update_key = jax.random.split(key)
        blank, stand = likelihood.start(start_key, scene), jnp.zeros_like(scene.present)
        keys = jax.random.split(update_key)
        return likelihood.update(keys, scene, stand, blank, anew=jnp.array(True)).log_likelihood

    batch = len(scenes.present)
    keys = jax.random.split(key, (count, batch))
    return jax.lax.map(lambda keys: jax.vmap(one)(keys, scenes), keys)


def _covered(layers_m: jax.Array) -> jax.Array:
    """Tiles (..., X) in which something is seen, of layers (..., X, TILE_PIXELS)."""
    return jnp.any(jnp.isfinite(layers_m), axis=-1)


def _log_mean_exp(log_values: jax.Array) -> jax.Array:
    """Over the last axis."""
    return jax.scipy.special.logsumexp(log_values, axis=-1) - math.log(log_values.shape[-1])


@custom_vmap
def _layers(images: DepthImages, shapes: jax.Array, poses: jax.Array) -> jax.Array:
    """Layers (..., R, N, X, TILE_PIXELS) of shapes (..., R, N) at poses (..., N, F, 7) camera_from_box."""
    frames = poses.shape[-2]
    posed_shape = (*shapes.shape, frames)
    index = jnp.broadcast_to(shapes[..., None], posed_shape)
    frame = jnp.broadcast_to(jnp.arange(frames, dtype=jnp.int32), posed_shape)
    poses = jnp.broadcast_to(poses[..., None, :, :, :], (*posed_shape, 7))
    with jax.enable_x64(False):  # the engine works in float32 and int32
        posed = images.renderer.posed(index.ravel(), poses.reshape(-1, 7), frame.ravel())
        library, cameras = images.renderer.library, images.cameras
        layers_m = render_tiles(library, posed, cameras, images.height, images.width)
    return layers_m.reshape(*shapes.shape, -1, TILE_PIXELS)


@_layers.def_vmap
def _(
    axis_size: int, in_batched: tuple, images: DepthImages, shapes: jax.Array, poses: jax.Array
) -> tuple[jax.Array, bool]:
    """Chains side by side are more objects to the engine, whose loops then stay full."""
    return _layers(images, *_broadcast(axis_size, in_batched, (shapes, poses))), True


@custom_vmap
def _gains(
    images: DepthImages,
    shapes: jax.Array,
    poses: jax.Array,
    others: jax.Array,
    layers_m: jax.Array,
    log_rest: jax.Array,
) -> jax.Array:
    """Log likelihood (..., K, R, F) of each frame with a shape (..., K, R) at a pose over that without it.

    Args:
        images: the likelihood.
        shapes: (..., K, R) indices.
        poses: (..., K, F, 7) camera_from_box.
        others: (..., N) which objects are the rest of the scene.
        layers_m: (..., R, N, X, TILE_PIXELS) of the scene.
        log_rest: (..., R, X) log density of the rest's tiles.
    """
    frames = poses.shape[-2]
    own_tiles = len(images.observed_m)
    tiles = own_tiles // frames
    draws, objects = layers_m.shape[-4:-2]
    posed_shape = (*shapes.shape, frames)
    index = jnp.broadcast_to(shapes[..., None], posed_shape)
    frame = jnp.broadcast_to(jnp.arange(frames, dtype=jnp.int32), posed_shape).ravel()
    draw = jnp.arange(log_rest[..., 0].size, dtype=jnp.int32).reshape(*log_rest.shape[:-2], 1, -1, 1)
    draw = jnp.broadcast_to(draw, posed_shape).ravel()
    poses = jnp.broadcast_to(poses[..., :, None, :, :], (*posed_shape, 7))
    layers_m = layers_m.reshape(-1, objects, own_tiles, TILE_PIXELS)
    others, log_rest = others.reshape(-1, objects), log_rest.reshape(-1, own_tiles)

    def add(
        gains: jax.Array, view: jax.Array, tile: jax.Array, depth_m: jax.Array, valid: jax.Array
    ) -> jax.Array:
        own, scene = frame[view] * tiles + tile, draw[view]
        rest_m = jnp.where(others[scene // draws][..., None], layers_m[scene, :, own], jnp.inf)
        shown_m = jnp.minimum(jnp.minimum(jnp.min(rest_m, axis=1), images.rest_m[own]), depth_m)
        gain = images._log_density(own, shown_m) - log_rest[scene, own]
        return gains.at[jnp.where(valid, view, len(gains))].add(gain, mode="drop")

    with jax.enable_x64(False):
        posed = images.renderer.posed(index.ravel(), poses.reshape(-1, 7), frame)
        zero = jnp.zeros(math.prod(posed_shape), jnp.float32)
        library, cameras = images.renderer.library, images.cameras
        gains = for_each_block(library, posed, cameras, images.height, images.width, add, zero)
    return gains.reshape(posed_shape)


@_gains.def_vmap
def _(axis_size: int, in_batched: tuple, images: DepthImages, *given: jax.Array) -> tuple[jax.Array, bool]:
    return _gains(images, *_broadcast(axis_size, in_batched, given)), True


def _broadcast(axis_size: int, in_batched: tuple, values: Sequence[jax.Array]) -> list[jax.Array]:
    """All values with the chains' axis, which the likelihood before them has not."""
    assert not any(jax.tree.leaves(in_batched[0]))
    return [
        value if batched else jnp.broadcast_to(value, (axis_size, *value.shape))
        for value, batched in zip(values, in_batched[1:], strict=True)
    ]
