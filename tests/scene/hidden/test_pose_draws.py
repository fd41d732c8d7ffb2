"""Draws that a rough look spares, against plain draws of the prior."""

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
import trimesh

from recordings.types import DepthNoise
from scene.hidden.depth_evidence import DepthImages, SeenImage
from scene.hidden.pose_draws import RouletteDraws
from scene.hidden.pose_priors import EulerUniformPoses
from scene.objects.scene_object import SceneObject, scene_object
from shapes.geometry.camera import Camera
from shapes.geometry.poses import motions_of

HEIGHT, WIDTH, FOCAL, FAR_M, SCREEN_M = 18, 24, 20.0, 2.0, 0.6
SIZE_M = 0.06, 0.04, 0.03

SHOWN = 9, 15
"""The pixel beside the screen in which something shows itself, row and column."""

NOISE = DepthNoise(
    sigma_base_m=0.01,
    sigma_growth_per_m=0.0,
    outlier_probability=0.1,
    none_hit_probability=0.0,
    none_miss_probability=0.0,
    max_range_m=FAR_M,
)
PRIOR = EulerUniformPoses(
    low_m=np.array([-0.14, -0.12, 0.45]),
    high_m=np.array([0.14, 0.12, 0.85]),
    world_from_cuboid=motions_of(np.array([0.02, 0.01, 0.0, 0.0, -0.05, 0.3])),
)


@lru_cache(maxsize=1)
def brick() -> SceneObject:
    """A small box."""
    mesh = trimesh.creation.box(SIZE_M)
    return scene_object("brick", mesh.vertices, mesh.faces)


@lru_cache(maxsize=1)
def images() -> DepthImages:
    """A screen before a far wall, and one pixel beside it that shows a point between them."""
    rest_m = np.full((HEIGHT, WIDTH), FAR_M, np.float32)
    rest_m[5:14, 9:15] = SCREEN_M
    observed_m = rest_m.copy()
    observed_m[SHOWN] = 0.7
    camera = Camera(*(jnp.float32(value) for value in (FOCAL, FOCAL, 11.5, 8.5)))
    seen = SeenImage(camera=camera, camera_from_world=np.eye(4), observed_m=observed_m, rest_m=rest_m[None])
    return DepthImages([seen], NOISE)


def test_roulette_keeps_the_mean(seed: int) -> None:
    """The same poses, all rendered, and by chance as the rough look says: four standard errors."""
    draws = RouletteDraws(one=brick(), prior=PRIOR, images=images())
    poses, log_weights = draws.draw(np.random.default_rng(seed), 2**16)
    ratios = images().log_ratios(brick(), PRIOR.draw(np.random.default_rng(seed + 1), [brick()], 2**14)[0])

    kept = np.zeros(2**16)
    kept[: len(log_weights)] = np.exp(log_weights)
    assert poses.shape == (1, len(log_weights), 4, 4)
    assert len(log_weights) < 0.8 * 2**16
    error = np.hypot(kept.std() / 2**8, np.exp(ratios).std() / 2**7)
    assert abs(kept.mean() - np.exp(ratios).mean()) < 4 * error
