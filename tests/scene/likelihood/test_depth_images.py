"""The likelihood that chains keep tile by tile is that of whole images, or of whole clouds."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from recordings.types import DepthNoise
from scene.likelihood.colour_density import ColourDensity
from scene.likelihood.colour_layers import ColourLayers, ColourTables, ComparedColours
from scene.likelihood.depth_images import DepthLikelihood, _log_mean_exp
from scene.likelihood.object_density import object_densities
from scene.likelihood.object_renderer import ObjectRenderer
from scene.likelihood.pixel_density import PixelDensity
from scene.likelihood.pixel_places import ImageParts
from scene.likelihood.point_clouds import POINT_WEIGHT, CloudLikelihood, CloudNoise, window_half_width
from scene.likelihood.shape_draws import candidate_keys
from scene.model.posterior import Estimate
from scene.model.scene_graph import SceneGraph, floating_scene
from scene.objects.scene_object import SceneObject, scene_object
from scene.observation.depth_view import unproject
from shapes.geometry.camera import Camera
from shapes.rendering.depth_rendering import render_layers
from shapes.rendering.tiles import to_tiles
from tests.scene.likelihood.whole_image import of_object
from tests.statistical import assert_mean

HEIGHT, WIDTH, BACKGROUND_M = 32, 48, 0.8
NOISE = DepthNoise(sigma_base_m=0.003, outlier_probability=0.1)
CLOUD = CloudNoise(outlier_probability=0.02, outlier_volume_m3=0.3, radius_m=0.02)


@pytest.fixture(scope="module")
def boxes() -> list[SceneObject]:
    """Two small boxes."""
    sizes = {"flat": (0.1, 0.06, 0.02), "long": (0.03, 0.03, 0.12)}
    meshes = {name: trimesh.creation.box(size) for name, size in sizes.items()}
    return [scene_object(name, mesh.vertices, mesh.faces) for name, mesh in meshes.items()]


@pytest.fixture(scope="module")
def poses() -> jax.Array:
    """Of both, one partly before the other."""
    with jax.enable_x64(True):
        turns = [[0.9, 0.3, 0.2, 0.1], [0.7, -0.4, 0.5, 0.2]]
        places = [[0.0, 0.0, 0.6], [0.02, 0.01, 0.5]]
        turns = np.array(turns) / np.linalg.norm(turns, axis=1, keepdims=True)
        return jnp.asarray(np.concatenate([turns, places], axis=1))


def images(
    shapes: list[SceneObject], observed_m: np.ndarray, *, objects: int = 2, draws: int = 1
) -> DepthLikelihood:
    """Two cameras side by side, a wall behind."""
    supports_m = np.full((2, HEIGHT, WIDTH), BACKGROUND_M, np.float32)
    by_frame = [
        PixelDensity.of(image.astype(np.float32), rest_m, NOISE, 0.002, 2)
        for image, rest_m in zip(observed_m, supports_m, strict=True)
    ]
    density = jax.tree.map(lambda *leaves: np.stack(leaves), *by_frame)
    camera = Camera(*(jnp.full(2, value, jnp.float32) for value in (60.0, 60.0, 23.5, 15.5)))
    return DepthLikelihood(
        renderer=replace(ObjectRenderer.of(shapes), draws=len(shapes) // objects),
        cameras=camera,
        camera_from_world=jnp.asarray([[1.0, 0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, 0.05, 0, 0]]),
        colours=None,
        density=density,
        rest_m=to_tiles(density.image.rest_m, 0.0),
        log_rest=to_tiles(density.log_rest, 0.0),
        fresh_share=jnp.ones(()),
        objects=objects,
        height=HEIGHT,
        width=WIDTH,
        draws=draws,
    )


def clouds(shapes: list[SceneObject], observed_m: np.ndarray) -> CloudLikelihood:
    """The same frames, whose points are of every third pixel, some of no return."""
    thinned = np.where(np.arange(WIDTH) % 3, 0, observed_m)
    thinned[:, :3] = 0
    alike = images(shapes, observed_m)
    camera = jax.tree.map(lambda leaf: leaf[0], alike.cameras)
    points_m = np.stack([unproject(image, camera).reshape(-1, 3) for image in thinned])
    return CloudLikelihood(
        **vars(alike),
        background_m=alike.rest_m,
        points_m=jnp.asarray(points_m, jnp.float32),
        cloud=CLOUD,
        half_width=window_half_width(float(CLOUD.radius_m), 0.4, 60.0, WIDTH),
    )


@jax.jit
def started(likelihood: DepthLikelihood, key: jax.Array, scene: SceneGraph) -> Estimate:
    """The estimate of a scene from scratch."""
    start_key, offer_key = jax.random.split(key)
    blank = likelihood.start(start_key, scene)
    alone, stand = beside(scene, scene.poses[None])
    offered = likelihood.offered(candidate_keys(offer_key, 1), alone, stand, blank, anew=jnp.array(True))
    return likelihood.chosen(offered, jnp.array(0))


def beside(scene: SceneGraph, poses: jax.Array) -> tuple[SceneGraph, jax.Array]:
    """Scenes with objects at poses (K, N, 7), and which stand elsewhere."""
    every = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[None], (len(poses), *leaf.shape)), scene)
    return replace(every, poses=poses), jnp.any(poses != scene.poses[None], axis=2)


@jax.jit
def offered(
    likelihood: DepthLikelihood, keys: jax.Array, scene: SceneGraph, poses: jax.Array, current: Estimate
) -> Estimate:
    """The estimates of scenes with objects at poses (K, N, 7), the present ones first."""
    return likelihood.offered(keys, *beside(scene, poses), current, anew=jnp.array(False))


def layers(likelihood: DepthLikelihood, scene: SceneGraph, frame: int) -> np.ndarray:
    """Depth (2, H, W) of each object alone in a frame."""
    shifted = scene.poses.at[:, 4:].add(jnp.asarray([0.05 * frame, 0, 0]))
    renderer = likelihood.renderer
    camera = jax.tree.map(lambda leaf: leaf[:1], likelihood.cameras)
    posed = renderer.posed(jnp.arange(2), shifted, jnp.zeros(2, jnp.int32))
    alone = np.asarray(render_layers(renderer.library, posed, camera, HEIGHT, WIDTH))
    return np.where(np.asarray(scene.present)[:, None, None], alone, np.inf)


def rendered(likelihood: DepthLikelihood, scene: SceneGraph, frame: int) -> np.ndarray:
    """The whole image (H, W) that a frame shows."""
    shown = layers(likelihood, scene, frame).min(axis=0)
    return np.minimum(shown, BACKGROUND_M)


shown_by_object = jax.jit(of_object)


def dense(likelihood: DepthLikelihood, observed_m: np.ndarray, scene: SceneGraph) -> float:
    """The log likelihood by whole images: every pixel has the factor of the nearest layer."""
    total = 0.0
    for frame in range(2):
        rest_m = np.full((HEIGHT, WIDTH), BACKGROUND_M, np.float32)
        density = PixelDensity.of(observed_m[frame].astype(np.float32), rest_m, NOISE, 0.002, 2)
        log_pixels, front_m = np.array(density.log_rest), rest_m
        for layer_m in layers(likelihood, scene, frame):
            log_mine, depth_m = (np.asarray(part) for part in shown_by_object(density, jnp.asarray(layer_m)))
            log_pixels = np.where(depth_m < front_m, log_mine, log_pixels)
            front_m = np.minimum(depth_m, front_m)
        total += float(log_pixels.astype(np.float64).sum())
    return total


def counted(likelihood: DepthLikelihood, observed_m: np.ndarray, scene: SceneGraph) -> float:  # noqa: ARG001
    """The log likelihood by whole clouds, whose neighbours a tree counts (main paper, section 3.3)."""
    assert isinstance(likelihood, CloudLikelihood)
    total = 0.0
    camera = jax.tree.map(lambda leaf: leaf[0], likelihood.cameras)
    for frame in range(2):
        cloud = unproject(rendered(likelihood, scene, frame), camera).reshape(-1, 3)
        points_m = np.asarray(likelihood.points_m[frame])
        points_m = points_m[points_m[:, 2] > 0]
        counts = KDTree(cloud).query_ball_point(points_m, CLOUD.radius_m, return_length=True)
        inlier = (1 - CLOUD.outlier_probability) / len(cloud) / (4 / 3 * np.pi * CLOUD.radius_m**3)
        density = CLOUD.outlier_probability / CLOUD.outlier_volume_m3 + inlier * counts
        total += POINT_WEIGHT * float(np.log(density).sum())
    return total


@pytest.mark.parametrize(
    ("compared", "whole"), [(images, dense), pytest.param(clouds, counted, marks=pytest.mark.slow)]
)
def test_every_way_to_a_scene_has_its_likelihood(
    key: jax.Array,
    seed: int,
    boxes: list[SceneObject],
    poses: jax.Array,
    compared: Callable[[list[SceneObject], np.ndarray], DepthLikelihood],
    whole: Callable[[DepthLikelihood, np.ndarray, SceneGraph], float],
) -> None:
    """From scratch, beside others or after them, one object moved or both: that of whole images or clouds."""
    observed_m = np.random.default_rng(seed).uniform(0.45, 0.85, (2, HEIGHT, WIDTH)).astype(np.float32)
    likelihood = compared(boxes, observed_m)
    scene = floating_scene(poses)
    steps = jnp.zeros((5, 2, 7)).at[1, 0, 4].set(0.03).at[2, 1, 4].set(0.4).at[3, 1, 6].set(-0.1)
    steps = steps.at[4, :, 5].set(jnp.array([0.02, -0.03]))
    start_key, offer_key, again_key = jax.random.split(key, 3)
    start = started(likelihood, start_key, scene)
    assert float(start.log_likelihood) == pytest.approx(whole(likelihood, observed_m, scene), abs=1e-2)
    keys, there = candidate_keys(offer_key, 6), scene.poses[None] + steps[jnp.array([0, 1, 2, 3, 4, 0])]
    chains = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), start)

    offered_to_each = jax.vmap(offered, in_axes=(None, None, None, None, 0))
    every = offered_to_each(likelihood, keys, scene, there, chains)

    np.testing.assert_array_equal(every.log_likelihood[0], every.log_likelihood[1])
    assert float(every.log_likelihood[0, 0]) == float(start.log_likelihood)
    for place, pair in enumerate(there):
        expected = whole(likelihood, observed_m, replace(scene, poses=pair))
        assert float(every.log_likelihood[0, place]) == pytest.approx(expected, abs=1e-2)
        after = jax.vmap(likelihood.chosen, in_axes=(0, None))(every, jnp.asarray(place))
        at, back = replace(scene, poses=pair), jnp.stack([pair, *[scene.poses] * 5])
        keys = candidate_keys(jax.random.clone(again_key), 6)
        again = offered_to_each(likelihood, keys, at, back, after)
        assert float(again.log_likelihood[0, 1]) == pytest.approx(float(start.log_likelihood), abs=1e-2)


def test_the_likelihood_of_frames_is_their_product(
    key: jax.Array, seed: int, boxes: list[SceneObject], poses: jax.Array
) -> None:
    """The log likelihood of two frames is the sum of those of each alone, to float32."""
    observed_m = np.random.default_rng(seed).uniform(0.45, 0.85, (2, HEIGHT, WIDTH)).astype(np.float32)
    both, scene = images(boxes, observed_m), floating_scene(poses)
    tiles = len(both.rest_m) // 2

    def alone(frame: int) -> DepthLikelihood:
        mine = slice(frame * tiles, (frame + 1) * tiles)
        one = slice(frame, frame + 1)
        return replace(
            both,
            cameras=jax.tree.map(lambda leaf: leaf[one], both.cameras),
            camera_from_world=both.camera_from_world[one],
            colours=None,
            density=jax.tree.map(lambda leaf: leaf[one], both.density),
            rest_m=both.rest_m[mine],
            log_rest=both.log_rest[mine],
        )

    keys = jax.random.split(key, 3)
    total = float(started(both, keys[0], scene).log_likelihood)
    parts = [float(started(alone(frame), keys[1 + frame], scene).log_likelihood) for frame in range(2)]
    assert total == pytest.approx(sum(parts), abs=1e-3)
    assert abs(parts[0] - parts[1]) > 1


def test_absent_objects_show_nothing(key: jax.Array, boxes: list[SceneObject], poses: jax.Array) -> None:
    """The likelihood of a scene with one object is that of the images without the other."""
    observed_m = np.full((2, HEIGHT, WIDTH), 0.79, np.float32)
    likelihood = images(boxes, observed_m)
    scene = floating_scene(poses, jnp.asarray([True, False]))
    start = started(likelihood, key, scene)
    assert float(start.log_likelihood) == pytest.approx(dense(likelihood, observed_m, scene), abs=1e-2)


@pytest.mark.slow  # tests/scene/mcmc/test_pseudo_marginal.py sees chains of such estimates
@pytest.mark.parametrize("draws", [1, 4])
def test_the_estimate_over_shapes_is_unbiased(
    key: jax.Array, seed: int, poses: jax.Array, draws: int
) -> None:
    """Its mean is the likelihood averaged over all known shapes; what has not moved keeps its own."""
    sizes = [(0.1, 0.06, 0.02 + 0.004 * extra) for extra in range(4)]
    meshes = [trimesh.creation.box(size) for size in sizes]
    shapes = [scene_object("it", mesh.vertices, mesh.faces) for mesh in meshes]
    observed_m = np.random.default_rng(seed).normal(0.61, 0.02, (2, HEIGHT, WIDTH))
    observed_m[:, :, :30] = 0.8
    scene = floating_scene(poses[:1])
    start_key, offer_key = jax.random.split(key)
    alone = [images([one], observed_m, objects=1) for one in shapes]
    exact = jnp.stack([started(one, jax.random.clone(key), scene).log_likelihood for one in alone])
    assert float(jnp.std(exact)) > 0.5
    log_exact = jax.scipy.special.logsumexp(exact) - np.log(len(shapes))
    likelihood = images(shapes, observed_m, objects=1, draws=draws)

    start = jax.vmap(started, in_axes=(None, 0, None))
    estimates = start(likelihood, jax.random.split(start_key, 800 // draws), scene).log_likelihood

    assert_mean(jnp.exp(estimates - log_exact), 1.0, detectable=0.4)
    current = started(likelihood, jax.random.clone(start_key), scene)
    again = started(likelihood, jax.random.clone(start_key), scene)
    assert float(again.log_likelihood) == float(current.log_likelihood)
    there = jnp.stack([poses[:1], poses[:1].at[0, 4].add(0.01), poses[:1]])
    once = offered(likelihood, candidate_keys(offer_key, 3), scene, there, current)
    twice = offered(likelihood, candidate_keys(jax.random.clone(offer_key), 3), scene, there, current)
    np.testing.assert_array_equal(once.log_likelihood, twice.log_likelihood)
    assert float(once.log_likelihood[2]) == float(current.log_likelihood)


@pytest.mark.parametrize("weight", [1.0, 0.5])
def test_colours_are_one_more_factor(
    seed: int, boxes: list[SceneObject], poses: jax.Array, weight: float
) -> None:
    """Of one frame: of the pixels that show an object, its factor in the whole window, to a power.

    Tiles are kept in single precision: 0.01 nats.
    """
    rng = np.random.default_rng(seed)
    painted = [
        one.coloured(mesh.vertices, mesh.faces, rng.integers(20, 230, (8, 3)).astype(np.uint8), 2.2)
        for one, mesh in zip(
            boxes, (trimesh.creation.box(2 * one.half_extents_m) for one in boxes), strict=True
        )
    ]
    observed_m = rng.normal(0.55, 0.05, (2, HEIGHT, WIDTH)).astype(np.float32)
    plain = images(boxes, observed_m)
    frame = 1
    with jax.enable_x64(False):  # as a parse has them
        colours = ColourLayers(
            density=ColourDensity.of(
                rng.normal(-1, 0.5, (HEIGHT, WIDTH, 3)), rng.random((HEIGHT, WIDTH)) < 0.9
            ),
            depth_density=jax.tree.map(lambda leaf: leaf[frame], plain.density),
            tables=ColourTables.of(painted),
            camera=jax.tree.map(lambda leaf: leaf[frame], plain.cameras),
        )
        compared = ComparedColours(colours, jnp.float32(weight), frame)
    with jax.enable_x64(True):
        scene = floating_scene(poses, jnp.array([True, True]))
        values = [
            float(started(one, jax.random.key(1), scene).log_likelihood)
            for one in (plain, replace(plain, colours=compared))
        ]
        layers_m = layers(plain, scene, frame)
        in_camera = np.array(poses)
        in_camera[:, 4] += 0.05
        with jax.enable_x64(False):
            layers_m = layers_m.astype(np.float32)
            factors = np.asarray(colours.log_factors(np.arange(2), in_camera, layers_m))
            frames = jnp.full(2, frame, jnp.int32)
            density = jax.tree.map(jnp.asarray, plain.density)
            _, depth_m = object_densities(density, jnp.asarray(layers_m), ImageParts(frames))
    depth_m = np.asarray(depth_m)
    nearest = depth_m.argmin(axis=0)
    own = np.take_along_axis(np.where(np.isfinite(layers_m), factors, 0.0), nearest[None], axis=0)[0]
    expected = weight * own[(depth_m.min(axis=0) < BACKGROUND_M)].sum()

    assert abs(expected) > 1
    assert values[1] - values[0] == pytest.approx(expected, abs=0.01)


def test_an_estimate_over_shapes_is_the_mean_of_likelihoods() -> None:
    """Not of their logs, and without overflow: of three draws in each of two rows."""
    log_values = jnp.asarray([[-1000.0, -1001.0, -2000.0], [3.0, 3.0, 3.0]])

    expected = [-1000.0 + np.log((1.0 + np.exp(-1.0)) / 3.0), 3.0]
    np.testing.assert_allclose(_log_mean_exp(log_values), expected, atol=1e-3)
