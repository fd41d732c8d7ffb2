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

from scene.likelihood import shape_draws
from scene.likelihood.colour_layers import ComparedColours
from scene.likelihood.object_density import object_densities
from scene.likelihood.object_renderer import ObjectRenderer
from scene.likelihood.pixel_density import PixelDensity
from scene.likelihood.pixel_places import ImageParts
from scene.likelihood.render_cache import CandidateScenes, RenderedScene
from scene.likelihood.shape_draws import candidate_keys
from scene.model.posterior import MOST_MOVED, Estimate
from scene.model.scene_graph import SceneGraph
from scene.objects.slots import OUT_OF_SIGHT
from scene.observation.frame_data import SceneData
from shapes.geometry.camera import Camera
from shapes.geometry.poses import pose_of
from shapes.rendering.depth_rendering import render_tiles
from shapes.rendering.ray_casting import sort_chosen_first
from shapes.rendering.tiles import TILE_PIXELS, from_tiles, to_tiles

TILES_TOGETHER = 64


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DepthLikelihood:
    """The density of depth images given whole scenes, the product over frames of `PixelDensity`.

    A pixel shows the nearest of the objects' layers, else the supports or what is unknown, as in the search.
    Objects are bodies 0..N-1.

    Where an object's shape is not certain, `renderer` holds S draws of every object's shape, draw after
    draw, and the likelihood is the mean over R independent choices among them: an unbiased estimate of
    the likelihood with the shapes summed out (supplement N). A moved object's choices, or a share of them,
    are made anew, the others' stay part of the chain's state (Tran et al. 2016, block pseudo-marginal).

    Attributes:
        renderer: S N shapes.
        cameras: leaves (F,), of the windows.
        camera_from_world: (F, 7).
        density: of the frames, leaves (F, ...).
        colours: of one of the frames; None where depth is compared alone.
        rest_m: (X, TILE_PIXELS) depth of the supports in the tiles of all frames, +inf beside them; 0 beyond
            the image, where nothing counts.
        log_rest: (X, TILE_PIXELS) log density where no object is.
        fresh_share: how many of the choices a new estimate makes anew.
        objects: N.
        height, width: of the windows.
        draws: R.
    """

    depends_on_graph: ClassVar[bool] = False
    renderer: ObjectRenderer
    cameras: Camera
    camera_from_world: jax.Array
    density: PixelDensity
    colours: ComparedColours | None
    rest_m: jax.Array
    log_rest: jax.Array
    fresh_share: jax.Array
    objects: int = field(metadata={"static": True})
    height: int = field(metadata={"static": True})
    width: int = field(metadata={"static": True})
    draws: int = field(default=1, metadata={"static": True})

    @classmethod
    def of(
        cls,
        views: Sequence[SceneData],
        densities: Sequence[PixelDensity],
        camera_from_world: NDArray[np.float64],
        renderer: ObjectRenderer,
        *,
        objects: int,
        draws: int = 1,
        colours: ComparedColours | None = None,
    ) -> DepthLikelihood:
        """The likelihood of the frames `views` from poses (F, 4, 4).

        Args:
            views: the frames.
            densities: of their windows.
            camera_from_world: of each.
            renderer: of all known shapes.
            objects: N.
            draws: R.
            colours: of one of the frames, where they are compared.
        """
        windows = [view.window for view in views]
        density = jax.tree.map(lambda *leaves: np.stack(leaves), *densities)
        height, width = windows[0].depth_m.shape
        return cls(
            renderer=renderer,
            cameras=jax.tree.map(lambda *leaves: np.stack(leaves), *[one.camera for one in windows]),
            camera_from_world=jax.vmap(pose_of)(jnp.asarray(camera_from_world)),
            density=density,
            colours=colours,
            rest_m=to_tiles(density.image.rest_m, 0.0),
            log_rest=to_tiles(density.log_rest, 0.0),
            fresh_share=jnp.ones(()),
            objects=objects,
            height=height,
            width=width,
            draws=draws,
        )

    def start(self, key: jax.Array, scene: SceneGraph) -> Estimate:
        """Shapes are drawn, nothing is rendered."""
        tiles = len(self.rest_m)
        layers_m = jnp.full((self.draws, self.objects, tiles, TILE_PIXELS), jnp.inf, jnp.float32)
        nowhere = jnp.zeros((self.draws, self.objects, tiles), bool)
        log_tiles = jnp.zeros((self.draws, tiles), jnp.float32)
        shapes = shape_draws.draw_shapes(key, (self.draws, self.objects), self.renderer.draws)
        shown = RenderedScene(shapes, layers_m, jnp.zeros_like(layers_m), nowhere, log_tiles)
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
            fresh_m, fresh_log = _layers(self, shape * objects + (one % objects)[None], poses)
            fresh = replace(
                shown,
                fresh_m=fresh_m,
                fresh_log=fresh_log,
                covered=jnp.any(jnp.isfinite(fresh_m), axis=-1),
                scene=jnp.where(anew, count, scene),
                body=body,
            )
            return jax.lax.cond(anew, lambda: replace(fresh, present=fresh.put(body)), lambda: fresh)

        no_layers = jnp.full((self.draws, places, *before.layers_m.shape[2:]), jnp.inf, jnp.float32)
        blank = CandidateScenes(
            present=before,
            shapes=shapes,
            log_tiles=jnp.broadcast_to(before.log_tiles[None], (count, *before.log_tiles.shape)),
            fresh_m=no_layers,
            fresh_log=jnp.zeros_like(no_layers),
            covered=jnp.zeros((self.draws, places, before.log_tiles.shape[1]), bool),
            scene=jnp.full(places, count, order.dtype),
            body=jnp.full(places, objects, order.dtype),
        )
        shown = jax.lax.fori_loop(0, jnp.where(anew, turns, 1), some, blank)
        stands = scenes.present[:, :objects] & ~moved
        shown = replace(shown, log_tiles=self.weighed(shown, stands, moved, anew))
        log_likelihood = _log_mean_exp(jnp.sum(shown.log_tiles, axis=2, dtype=self.fresh_share.dtype))
        is_kept = (jnp.arange(count) == 0) & ~anew
        return Estimate(jnp.where(is_kept, current.log_likelihood, log_likelihood), shown)

    def chosen(self, offered: Estimate, place: jax.Array) -> Estimate:
        """Its layers and tiles take the place of the first's."""
        shown: CandidateScenes = offered.draws
        body = jnp.where(shown.scene == place, shown.body, self.objects)
        present = replace(shown.put(body), shapes=shown.shapes[place], log_tiles=shown.log_tiles[place])
        return Estimate(offered.log_likelihood[place], present)

    def _redrawn(self, keys: jax.Array, shapes: jax.Array) -> jax.Array:
        if self.renderer.draws == 1:
            return shapes
        return shape_draws.redraw_shapes(keys, shapes, self.renderer.draws, self.fresh_share)

    def weighed(
        self, shown: CandidateScenes, stands: jax.Array, moved: jax.Array, anew: jax.Array
    ) -> jax.Array:
        """Log densities (K, R, X) of all tiles, brought up to date where something has moved.

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
        order = jnp.pad(order, (0, -len(order) % TILES_TOGETHER))  # a slice beyond the end would slide back
        uses = jnp.concatenate([stands, mine], axis=1)
        owners = jnp.concatenate([jnp.arange(self.objects), shown.body])

        def some(turn: jax.Array, log_tiles: jax.Array) -> jax.Array:
            which = jax.lax.dynamic_slice_in_dim(order, turn * TILES_TOGETHER, TILES_TOGETHER)
            there = turn * TILES_TOGETHER + jnp.arange(TILES_TOGETHER, dtype=jnp.int32) < number
            scene, draw, tile = which // (draws * tiles), which // tiles % draws, which % tiles
            present, used = shown.present, uses[scene][:, :, None]
            layers_m, log_layers = (
                jnp.concatenate([now[draw, :, tile], fresh[draw, :, tile]], axis=1)
                for now, fresh in ((present.layers_m, shown.fresh_m), (present.log_layers, shown.fresh_log))
            )
            log_mine = self._log_density(tile, jnp.where(used, layers_m, jnp.inf), log_layers, owners)
            return log_tiles.at[jnp.where(there, which, len(log_tiles))].set(log_mine, mode="drop")

        turns = -(-number // TILES_TOGETHER)
        return jax.lax.fori_loop(0, turns, some, shown.log_tiles.ravel()).reshape(count, draws, tiles)

    def shown(
        self, layers_m: jax.Array, frames: jax.Array, objects: jax.Array, poses: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Depth (n, H, W) at which layers (n, H, W) of frames (n,) hide others; log density of their pixels.

        They reach to the pixels beside an object, which its outline may be shifted to. Objects (n,) stand at
        poses (n, 7) camera_from_box.
        """
        log_density, depth_m = object_densities(self.density, layers_m, ImageParts(frames))
        if self.colours is not None:
            log_colour = self.colours.log_factors(frames, objects, poses, layers_m)
            log_density += jnp.where(jnp.isfinite(depth_m), log_colour, 0.0)
        return depth_m, log_density

    def _log_density(
        self, tile: jax.Array, layers_m: jax.Array, log_layers: jax.Array, owners: jax.Array
    ) -> jax.Array:
        """Log density (B,) of tiles (B,) with layers (B, L, TILE_PIXELS) of objects (L,).

        Of equally near ones, as beside two outlines, the first object's counts, wherever its layer is kept.
        """
        first = jnp.min(layers_m, axis=1, keepdims=True)
        places = jnp.where(layers_m == first, owners[:, None], self.objects + 1)
        nearest = jnp.argmin(places, axis=1)[:, None]
        depth_m, log_nearest = (
            jnp.take_along_axis(part, nearest, axis=1)[:, 0] for part in (layers_m, log_layers)
        )
        log_pixels = jnp.where(depth_m < self.rest_m[tile], log_nearest, self.log_rest[tile])
        return jnp.sum(log_pixels, axis=1, dtype=jnp.float32)

    def _seen(self, poses: jax.Array) -> jax.Array:
        """Poses (n, F, 7) float32 in every camera of poses (n, 7) in the world."""

        def in_camera(camera: jax.Array, pose: jax.Array) -> jax.Array:
            return (jaxlie.SE3(camera) @ jaxlie.SE3(pose)).wxyz_xyz

        in_cameras = jax.vmap(jax.vmap(in_camera, in_axes=(0, None)), in_axes=(None, 0))
        return in_cameras(self.camera_from_world, poses).astype(jnp.float32)


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


@jax.jit
def _shown(images: DepthLikelihood, shapes: jax.Array, poses: jax.Array) -> tuple[jax.Array, jax.Array]:
    """What shapes (..., R, N) show at poses (..., N, F, 7) camera_from_box.

    Returns:
        Depth at which they hide others and log density, (..., R, N, X, TILE_PIXELS) each.
    """
    frames = poses.shape[-2]
    posed_shape = (*shapes.shape, frames)
    index = jnp.broadcast_to(shapes[..., None], posed_shape)
    frame = jnp.broadcast_to(jnp.arange(frames, dtype=jnp.int32), posed_shape).ravel()
    poses = jnp.broadcast_to(poses[..., None, :, :, :], (*posed_shape, 7))
    objects = (index.ravel() % images.objects).astype(jnp.int32)
    with jax.enable_x64(False):  # the engine works in float32 and int32
        posed = images.renderer.posed(index.ravel(), poses.reshape(-1, 7), frame)
        library, cameras, size = images.renderer.library, images.cameras, (images.height, images.width)
        layers_m = from_tiles(render_tiles(library, posed, cameras, *size), *size)
        depth_m, log_density = images.shown(layers_m, frame, objects, poses.reshape(-1, 7))
        tiles = to_tiles(depth_m, jnp.inf), to_tiles(log_density, 0.0)
    depth_m, log_density = (part.reshape(*shapes.shape, -1, TILE_PIXELS) for part in tiles)
    return depth_m, log_density


@custom_vmap
def _layers(images: DepthLikelihood, shapes: jax.Array, poses: jax.Array) -> tuple[jax.Array, jax.Array]:
    """`_shown`: as a kernel it is traced once for one chain and once for many, whatever loops it is in."""
    return _shown(images, shapes, poses)


@_layers.def_vmap
def _(
    axis_size: int, in_batched: tuple, images: DepthLikelihood, shapes: jax.Array, poses: jax.Array
) -> tuple[tuple[jax.Array, jax.Array], tuple[bool, bool]]:
    """Chains side by side are more objects to the engine, whose loops then stay full."""
    of_images, *of_given = in_batched
    assert not any(jax.tree.leaves(of_images))  # all chains have one likelihood
    given = [
        value if batched else jnp.broadcast_to(value, (axis_size, *value.shape))
        for value, batched in zip((shapes, poses), of_given, strict=True)
    ]
    return _layers(images, *given), (True, True)
