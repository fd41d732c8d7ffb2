"""The likelihood of whole scenes in chains: depth images in which the nearest surface is seen.

A chain keeps what each object shows, cut into tiles, and the log density of every tile, so that a scene
costs the tiles that its moved objects cover, or covered, and no others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.custom_batching import custom_vmap
from numpy.typing import NDArray

from recordings.types import DepthNoise
from scene.likelihood import shape_draws
from scene.likelihood.object_renderer import ObjectRenderer
from scene.likelihood.render_cache import CandidateScenes, RenderedScene
from scene.likelihood.shape_draws import candidate_keys
from scene.model.posterior import MOST_MOVED, Estimate
from scene.model.scene_graph import SceneGraph
from scene.objects.slots import OUT_OF_SIGHT
from scene.observation.frame_data import SceneData
from shapes import depth_noise
from shapes.geometry.camera import Camera
from shapes.geometry.poses import pose_of
from shapes.rendering.depth_rendering import render_tiles
from shapes.rendering.ray_casting import sort_chosen_first
from shapes.rendering.tiles import TILE_PIXELS, to_tiles

TILES_TOGETHER = 64


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DepthLikelihood:
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
    ) -> DepthLikelihood:
        """The likelihood of the frames `views` from poses (F, 4, 4).

        A finer window has more pixels of the same image and not more information: `pixel_weight` counts
        the pixels of the search's window.
        """
        rest_m = [np.where(view.detail.inside, view.detail_rest_m, 0) for view in views]
        shares = [(view.detail.stride / view.window.stride) ** 2 for view in views]
        height, width = rest_m[0].shape
        return cls(
            renderer=renderer,
            cameras=jax.tree.map(lambda *leaves: np.stack(leaves), *[view.detail.camera for view in views]),
            camera_from_world=jax.vmap(pose_of)(jnp.asarray(camera_from_world)),
            observed_m=_cut(np.stack([view.detail.depth_m for view in views])),
            rest_m=_cut(np.stack(rest_m).astype(np.float32)),
            weights=jax.device_put(pixel_weight * np.array(shares)),
            noise=jax.tree.map(np.float32, noise),
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
        nowhere = jnp.zeros((self.draws, self.objects, tiles), bool)
        log_tiles = jnp.zeros((self.draws, tiles), jnp.float32)
        shapes = shape_draws.draw_shapes(key, (self.draws, self.objects), self._known)
        shown = RenderedScene(shapes, layers_m, nowhere, log_tiles)
        return Estimate(jnp.zeros((), scene.poses.dtype), shown)

    def offered(
        self, keys: jax.Array, scenes: SceneGraph, moved: jax.Array, current: Estimate, *, anew: jax.Array
    ) -> Estimate:
        """What moved in one of the scenes is rendered, or with `anew` all of the first; tiles are weighed."""
        count, objects = len(keys), self.objects
        places = max(count - 1, min(MOST_MOVED, objects))
        turns = -(-objects // places)
        before: RenderedScene = current.draws
        moved = moved[:, :objects]
        shapes = jax.vmap(self._redrawn, in_axes=(0, None))(keys, before.shapes)
        shapes = jnp.where(moved[:, None], shapes, before.shapes[None])
        seen = self._seen(scenes.poses[:, :objects].reshape(-1, 7))
        rendered = moved | (anew & (jnp.arange(count) == 0))[:, None]
        order = jnp.nonzero(rendered.ravel(), size=turns * places, fill_value=count * objects)[0]

        def some(turn: jax.Array, shown: CandidateScenes) -> CandidateScenes:
            which = jax.lax.dynamic_slice_in_dim(order, turn * places, places)
            there, one = which < count * objects, jnp.minimum(which, count * objects - 1)
            aside = jnp.asarray(OUT_OF_SIGHT, jnp.float32)
            poses = jnp.where(there[:, None, None], seen[one], aside[None, None])
            scene, body = which // objects, jnp.where(there, one % objects, objects)
            shape = jnp.moveaxis(shapes, 1, 2).reshape(count * objects, -1)[one].T
            fresh_m = _layers(self, shape * objects + (one % objects)[None], poses)
            fresh = replace(
                shown,
                fresh_m=fresh_m,
                covered=jnp.any(jnp.isfinite(fresh_m), axis=-1),
                scene=jnp.where(anew, count, scene),
                body=body,
            )
            return jax.lax.cond(anew, lambda: replace(fresh, present=fresh.put(body)), lambda: fresh)

        blank = CandidateScenes(
            present=before,
            shapes=shapes,
            log_tiles=jnp.broadcast_to(before.log_tiles[None], (count, *before.log_tiles.shape)),
            fresh_m=jnp.full((self.draws, places, *before.layers_m.shape[2:]), jnp.inf, jnp.float32),
            covered=jnp.zeros((self.draws, places, before.log_tiles.shape[1]), bool),
            scene=jnp.full(places, count, order.dtype),
            body=jnp.full(places, objects, order.dtype),
        )
        shown = jax.lax.fori_loop(0, jnp.where(anew, turns, 1), some, blank)
        stands = scenes.present[:, :objects] & ~moved
        shown = replace(shown, log_tiles=self.weighed(shown, stands, moved, anew))
        log_likelihood = _log_mean_exp(jax.vmap(self._log_each)(shown.log_tiles))
        is_kept = (jnp.arange(count) == 0) & ~anew
        return Estimate(jnp.where(is_kept, current.log_likelihood, log_likelihood), shown)

    def chosen(self, offered: Estimate, place: jax.Array) -> Estimate:
        """Its layers and tiles take the place of the first's."""
        shown: CandidateScenes = offered.draws
        body = jnp.where(shown.scene == place, shown.body, self.objects)
        present = replace(shown.put(body), shapes=shown.shapes[place], log_tiles=shown.log_tiles[place])
        return Estimate(offered.log_likelihood[place], present)

    @property
    def _known(self) -> int:
        """S."""
        return len(self.renderer.library) // self.objects

    def _redrawn(self, keys: jax.Array, shapes: jax.Array) -> jax.Array:
        if self._known == 1:
            return shapes
        return shape_draws.redraw_shapes(keys, shapes, self._known, self.fresh_share)

    def weighed(
        self, shown: CandidateScenes, stands: jax.Array, moved: jax.Array, anew: jax.Array
    ) -> jax.Array:
        """Log densities (K, R, X) of all tiles, exponent 1, brought up to date where something has moved.

        Args:
            shown: with those of the present scene in every place.
            stands: (K, N) objects that are where they are in the present scene.
            moved: (K, N) those that are not.
            anew: whether all of the first is to be done.
        """
        count, draws, tiles = shown.log_tiles.shape
        mine = shown.scene[None] == jnp.arange(count)[:, None]
        left = jnp.any(moved[:, None, :, None] & shown.present.covered[None], axis=2)
        entered = jnp.any(mine[:, None, :, None] & shown.covered[None], axis=2)
        first = (jnp.arange(count) == 0)[:, None, None]
        order, number = sort_chosen_first(((left | entered) | (first & anew)).ravel())
        uses = jnp.concatenate([stands, mine], axis=1)

        def some(turn: jax.Array, log_tiles: jax.Array) -> jax.Array:
            which = jax.lax.dynamic_slice_in_dim(order, turn * TILES_TOGETHER, TILES_TOGETHER)
            there = turn * TILES_TOGETHER + jnp.arange(TILES_TOGETHER, dtype=jnp.int32) < number
            scene, draw, tile = which // (draws * tiles), which // tiles % draws, which % tiles
            layers_m = jnp.concatenate(
                [shown.present.layers_m[draw, :, tile], shown.fresh_m[draw, :, tile]], axis=1
            )
            depth_m = jnp.min(jnp.where(uses[scene][:, :, None], layers_m, jnp.inf), axis=1)
            log_mine = self._log_density(tile, jnp.minimum(depth_m, self.rest_m[tile]))
            return log_tiles.at[jnp.where(there, which, len(log_tiles))].set(log_mine, mode="drop")

        turns = -(-number // TILES_TOGETHER)
        return jax.lax.fori_loop(0, turns, some, shown.log_tiles.ravel()).reshape(count, draws, tiles)

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


@jax.jit
def _cut(images: jax.Array) -> jax.Array:
    return to_tiles(images, 0.0)


@partial(jax.jit, static_argnames="count")
def log_estimates(key: jax.Array, likelihood: DepthLikelihood, scenes: SceneGraph, count: int) -> jax.Array:
    """Estimates (count, B) of the log likelihood of each of B scenes, all shapes drawn anew for each."""

    def one(key: jax.Array, scene: SceneGraph) -> jax.Array:
        start_key, update_key = jax.random.split(key)
        blank = likelihood.start(start_key, scene)
        alone = jax.tree.map(lambda leaf: leaf[None], scene)
        keys, stand = candidate_keys(update_key, 1), jnp.zeros_like(alone.present)
        return likelihood.offered(keys, alone, stand, blank, anew=jnp.array(True)).log_likelihood[0]

    batch = len(scenes.present)
    keys = jax.random.split(key, (count, batch))
    return jax.lax.map(lambda keys: jax.vmap(one)(keys, scenes), keys)


def _log_mean_exp(log_values: jax.Array) -> jax.Array:
    """Over the last axis."""
    return jax.scipy.special.logsumexp(log_values, axis=-1) - math.log(log_values.shape[-1])


@custom_vmap
def _layers(images: DepthLikelihood, shapes: jax.Array, poses: jax.Array) -> jax.Array:
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
    axis_size: int, in_batched: tuple, images: DepthLikelihood, shapes: jax.Array, poses: jax.Array
) -> tuple[jax.Array, bool]:
    """Chains side by side are more objects to the engine, whose loops then stay full."""
    return _layers(images, *_broadcast(axis_size, in_batched, (shapes, poses))), True


def _broadcast(axis_size: int, in_batched: tuple, values: Sequence[jax.Array]) -> list[jax.Array]:
    """All values with the chains' axis, which the likelihood before them has not."""
    assert not any(jax.tree.leaves(in_batched[0]))
    return [
        value if batched else jnp.broadcast_to(value, (axis_size, *value.shape))
        for value, batched in zip(values, in_batched[1:], strict=True)
    ]
