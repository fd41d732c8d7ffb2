"""Stage K of the supplement: a search for the most probable scene, which gives chains their start.

Hypotheses come from observed points and from DBSCAN clusters of points that the scene without the object
leaves unexplained, in resting, cube and spread orientations, refined by ICP; whole scenes are annealed
over the pools; then the search is repeated on what is left unexplained. The result is a maximum and a
set of hypotheses, never samples (MATH.md section K).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from scene.detection import SupportPlane, clusters
from scene.icp import align, look_up
from scene.observation import DepthView, unprojected
from scene.orientations import cube_rotations, resting_rotations, spread_rotations
from scene.pose_choice import PoseLayers, choose, log_conditional
from scene.rendering import OUT_OF_SIGHT, ObjectRenderer
from scene.scene_object import SceneObject
from scene.template_search import search
from scene.window import PixelWindow
from shapes import depth_noise

ORIENTATIONS, FREE_ORIENTATIONS = 320, 576
YAWS = 16
ANCHORS, CENTRES = 128, 8
ANCHOR_SPACING_M = 0.015
CLUSTER_SCALES_M = (0.01, 0.02, 0.04)
UNEXPLAINED_M = 0.012
FOREGROUND_PIXELS = 1024
LOWEST_LOG_DENSITY = -20.0
HOT, COLD, SWEEPS, PARTICLES = 150.0, 2.0, 12, 8
POLISH_ROUNDS, POLISH_ITERATIONS = 4, 6
POLISH_FIRST_M, POLISH_LAST_M = 0.006, 0.002
SELF_OCCLUSION_M = 0.008
"""A surface point that lies further behind the rendered scene is hidden."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneData:
    """What one frame gives to the search.

    Attributes:
        view: pooled image.
        foreground: (H, W) bool, the view's pixels that may show an object.
        window: the pixels on which scenes are compared.
        window_foreground: its pixels that may show an object.
        rest_m: the window's background depth: the table's plane, elsewhere what was seen; +inf if nothing.
        table: None where nothing supports the objects.
    """

    view: DepthView
    foreground: NDArray[np.bool_]
    window: PixelWindow
    window_foreground: NDArray[np.bool_]
    rest_m: NDArray[np.float32]
    table: SupportPlane | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Initialisation:
    """The best scene found and the pools that it was chosen from.

    Attributes:
        poses: (N, 7) camera_from_box, wxyz_xyz; meaningless where not found.
        found: (N,) bool.
        pools: (N, K, 7).
        log_gains: (N, K) log density of the scene with each pose of the pool in place of the best one,
            less that of the best scene; the last column is without the object.
    """

    poses: NDArray[np.float64]
    found: NDArray[np.bool_]
    pools: NDArray[np.float64]
    log_gains: NDArray[np.float64]


def initialise(
    key: jax.Array,
    data: SceneData,
    objects: Sequence[SceneObject],
    renderer: ObjectRenderer,
    noise: DepthNoise,
    surface_sigma_m: float,
    *,
    rounds: int,
    pool: int,
) -> Initialisation:
    """Search for the scene.

    Args:
        key: random key.
        data: one frame.
        objects: what to look for.
        renderer: of the same objects.
        noise: of the sensor.
        surface_sigma_m: error of surfaces, of shapes and of poses in the pool together.
        rounds: of renewed search on what is left unexplained.
        pool: poses an object and round.
    """
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    rotations = [_orientations(one, data.table) for one in objects]
    unexplained = [data.foreground] * len(objects)
    pools = jnp.tile(jnp.asarray(OUT_OF_SIGHT, jnp.float32), (len(objects), pool * (rounds + 1), 1))
    chosen = np.full(len(objects), pools.shape[1])
    layers = None
    for turn, round_key in enumerate(jax.random.split(key, rounds + 1)):
        found = [
            _hypotheses(data, one, turns, mask, rng, pool)
            for one, turns, mask in zip(objects, rotations, unexplained, strict=True)
        ]
        pools = pools.at[:, turn * pool : (turn + 1) * pool].set(jnp.stack(found))
        layers = _layers(data, renderer, pools, noise, surface_sigma_m, rng)
        choices, log_densities = choose(round_key, layers, HOT, COLD, PARTICLES, SWEEPS)
        chosen = np.asarray(choices[jnp.argmax(log_densities)])
        unexplained = _unexplained_without_each(data, renderer, pools, chosen)
    assert layers is not None
    present = np.asarray(chosen < pools.shape[1])
    poses = np.asarray(pools)[np.arange(len(objects)), np.minimum(chosen, pools.shape[1] - 1)]
    poses = _polished(data, objects, renderer, poses, present)
    return Initialisation(
        poses=poses.astype(np.float64),
        found=present,
        pools=np.asarray(pools, np.float64),
        log_gains=_log_gains(layers, chosen),
    )


def _orientations(one: SceneObject, table: SupportPlane | None) -> NDArray[np.float32]:
    """Camera_from_box rotations (O, 3, 3): resting, the cube's 24, and an even spread."""
    if table is None:
        return spread_rotations(FREE_ORIENTATIONS).astype(np.float32)
    fixed = np.concatenate([resting_rotations(one.rests, YAWS), cube_rotations()])
    fixed = table.camera_from_table[:3, :3] @ fixed
    return np.concatenate([fixed, spread_rotations(ORIENTATIONS - len(fixed))]).astype(np.float32)


def _hypotheses(
    data: SceneData,
    one: SceneObject,
    rotations: NDArray[np.float32],
    mask: NDArray[np.bool_],
    rng: np.random.Generator,
    pool: int,
) -> jax.Array:
    anchors, centres = _places(data, mask, rng)
    poses, _ = search(
        replace(data.view, unexplained=jnp.asarray(mask)),
        jnp.asarray(one.points_m),
        jnp.asarray(one.normals),
        jnp.asarray(rotations),
        jnp.asarray(anchors),
        jnp.asarray(centres),
        pool,
    )
    return poses


def _places(
    data: SceneData, mask: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Anchors (ANCHORS, 3) spread over the masked points, and cluster centres (CENTRES, 3)."""
    points = unprojected(np.asarray(data.view.depth_m), data.view.camera).astype(np.float32)
    masked = points[mask]
    if len(masked) < 10:
        masked = points[data.foreground]
    _, first = np.unique(np.floor(masked / ANCHOR_SPACING_M).astype(int), axis=0, return_index=True)
    anchors = masked[rng.permutation(first)]
    centres = clusters(anchors, CLUSTER_SCALES_M, fewest=3)
    centres = np.concatenate([centres, masked.mean(axis=0)[None]])
    return np.resize(anchors, (ANCHORS, 3)).astype(np.float32), np.resize(centres, (CENTRES, 3)).astype(
        np.float32
    )


def _layers(
    data: SceneData,
    renderer: ObjectRenderer,
    pools: jax.Array,
    noise: DepthNoise,
    surface_sigma_m: float,
    rng: np.random.Generator,
) -> PoseLayers:
    """Layers of all pools, an absent object last, on at most FOREGROUND_PIXELS pixels of the foreground."""
    count, poses = pools.shape[:2]
    indices = jnp.repeat(jnp.arange(count), poses)
    depth = renderer.layers(indices, pools.reshape(-1, 7), data.window).reshape(count, poses, -1)
    near, inside = data.window_foreground.ravel(), data.window.inside.ravel()
    places = rng.permutation(np.flatnonzero(near & inside))
    share = min(FOREGROUND_PIXELS / max(len(places), 1), 1.0)
    weight = np.zeros(FOREGROUND_PIXELS, np.float32)
    weight[: len(places)] = 1 / share
    return _pose_layers(
        depth,
        noise,
        surface_sigma_m,
        jnp.asarray(data.window.depth_m.ravel()),
        jnp.asarray(data.rest_m.ravel()),
        jnp.asarray(inside & ~near),
        jnp.asarray(np.resize(places, FOREGROUND_PIXELS)),
        jnp.asarray(weight),
    )


@jax.jit
def _pose_layers(
    depth_m: jax.Array,
    noise: DepthNoise,
    surface_sigma_m: float,
    observed_m: jax.Array,
    rest_m: jax.Array,
    uncontested: jax.Array,
    places: jax.Array,
    weight: jax.Array,
) -> PoseLayers:
    """Layers (N, K + 1, X) of depth (N, K, pixels) at weighted places; uncontested pixels are summed up."""
    count, _, pixels = depth_m.shape
    depth_m = jnp.concatenate([depth_m, jnp.full((count, 1, pixels), jnp.inf)], axis=1)

    def log_density(observed_m: jax.Array, depth_m: jax.Array) -> jax.Array:
        observed_m = jnp.broadcast_to(observed_m, depth_m.shape)
        density = depth_noise.log_density(noise, observed_m, depth_m, surface_sigma_m)
        return jnp.maximum(density, LOWEST_LOG_DENSITY)

    rest = log_density(observed_m, rest_m)

    def alone(layer_m: jax.Array) -> jax.Array:
        gain = log_density(observed_m, layer_m) - rest
        return jnp.sum(jnp.where(uncontested & (layer_m < rest_m), gain, 0.0))

    log_alone = jax.lax.map(alone, depth_m.reshape(-1, pixels)).reshape(depth_m.shape[:2])
    shown_m = depth_m[:, :, places]
    return PoseLayers(
        depth_m=shown_m,
        log_density=log_density(observed_m[places][None, None], shown_m) * weight[None, None],
        log_alone=log_alone,
        rest_m=rest_m[places],
        rest_log_density=rest[places] * weight,
    )


def _unexplained_without_each(
    data: SceneData, renderer: ObjectRenderer, pools: jax.Array, chosen: NDArray[np.int64]
) -> list[NDArray[np.bool_]]:
    """For every object, the foreground that the scene without it leaves unexplained."""
    count, poses = pools.shape[:2]
    placed = pools[jnp.arange(count), jnp.minimum(chosen, poses - 1)]
    depth = np.asarray(renderer.view_layers(jnp.arange(count), placed, data.view)).copy()
    depth[chosen >= poses] = np.inf
    observed = np.asarray(data.view.depth_m)
    masks = []
    for one in range(count):
        others = np.delete(depth, one, axis=0).min(axis=0, initial=np.inf)
        masks.append(data.foreground & ~(np.abs(observed - others) < UNEXPLAINED_M))
    return masks


def _polished(
    data: SceneData,
    objects: Sequence[SceneObject],
    renderer: ObjectRenderer,
    poses: NDArray[np.floating],
    present: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """ICP of the rendered visible clouds of the whole scene, rendered anew in an outer loop."""
    current = jnp.asarray(poses, jnp.float32)
    points = jnp.stack([jnp.asarray(one.points_m) for one in objects])
    normals = jnp.stack([jnp.asarray(one.normals) for one in objects])
    for _ in range(POLISH_ROUNDS):
        layers = renderer.view_layers(jnp.arange(len(objects)), current, data.view)
        layers = jnp.where(jnp.asarray(present)[:, None, None], layers, jnp.inf)
        current = _polish_once(data.view, points, normals, current, jnp.min(layers, axis=0))
    return np.asarray(current)


@jax.jit
def _polish_once(
    view: DepthView, points_m: jax.Array, normals: jax.Array, poses: jax.Array, scene_m: jax.Array
) -> jax.Array:
    """One round: a point takes part if the rendered scene shows it."""
    rendered = replace(view, depth_m=jnp.where(jnp.isfinite(scene_m), scene_m, 0.0))

    def one(points_m: jax.Array, normals: jax.Array, pose: jax.Array) -> jax.Array:
        placed = jax.vmap(jaxlie.SE3(pose).apply)(points_m)
        front = look_up(rendered, placed)
        visible = front.measured & (placed[:, 2] < front.surface_m[:, 2] + SELF_OCCLUSION_M)
        return align(
            view,
            points_m,
            normals,
            visible[None],
            pose[None],
            POLISH_FIRST_M,
            POLISH_LAST_M,
            POLISH_ITERATIONS,
        )[0]

    return jax.vmap(one)(points_m, normals, poses)


@jax.jit
def _gains(layers: PoseLayers, chosen: jax.Array) -> jax.Array:
    conditionals = jax.vmap(lambda index: log_conditional(layers, chosen, index))(jnp.arange(len(chosen)))
    return conditionals - conditionals[jnp.arange(len(chosen)), chosen][:, None]


def _log_gains(layers: PoseLayers, chosen: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.asarray(_gains(layers, jnp.asarray(chosen)), np.float64)
