"""A thing that nobody asked for is not taken for a shape that is like it, and the shape itself is."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from pipeline.synthesis.world import Part, RayCaster
from recordings.types import NO_RETURN, CameraIntrinsics, DepthNoise
from scene.likelihood.pixel_density import PixelDensity
from scene.model.presence import LOG_SHARE_OF_POSES
from scene.observation.frame_data import SceneData
from scene.observation.segmentation import scene_data, support_depth

INTRINSICS = CameraIntrinsics(width=320, height=240, fx=280.0, fy=280.0, cx=159.5, cy=119.5)
NOISE, SHAPE_SIGMA_M = DepthNoise(), 0.003
SHAPES = {
    "box": trimesh.creation.box((0.10, 0.07, 0.16)),
    "slab": trimesh.creation.box((0.18, 0.07, 0.09)),
    "can": trimesh.creation.cylinder(radius=0.045, height=0.16),
    "ball": trimesh.creation.icosphere(radius=0.06),
    "drum": trimesh.creation.cylinder(radius=0.06, height=0.16),
    "brick": trimesh.creation.box((0.14, 0.09, 0.16)),
    "plank": trimesh.creation.box((0.03, 0.06, 0.18)),
}


def seen(*shapes: str) -> NDArray[np.floating]:
    """Depth (240, 320) of a table with shapes on it, each behind the one before."""
    table = trimesh.creation.box((1.0, 1.0, 0.02))
    parts = [Part(name="table", mesh=table, world_from_part=moved(0, 0, -0.01))]
    parts += [
        Part(name=shape, mesh=SHAPES[shape], world_from_part=standing(shape, place))
        for place, shape in enumerate(shapes)
    ]
    return RayCaster(parts).view(INTRINSICS, camera()).depth_m


def standing(shape: str, place: int) -> NDArray[np.float64]:
    """World_from_shape (4, 4): the first in the table's middle, others farther away and to the right."""
    pose = trimesh.transformations.rotation_matrix(0.5, (0, 0, 1))
    pose[:3, 3] = 0.16 * place, 0.16 * place, -SHAPES[shape].bounds[0, 2]
    return pose


def camera() -> NDArray[np.float64]:
    """World_from_camera (4, 4), obliquely from above."""
    forward = np.array([0.0, 0.6, -0.4]) / np.hypot(0.6, 0.4)
    right = np.array([1.0, 0.0, 0.0])
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, [0.0, -0.6, 0.45]], axis=1)
    return pose


def moved(*offset_m: float) -> NDArray[np.float64]:
    """A pose (4, 4) that is not turned."""
    return trimesh.transformations.translation_matrix(offset_m)


def observed(*shapes: str, seed: int) -> SceneData:
    """What a noisy camera sees of them."""
    depth_m = seen(*shapes)
    noisy_m = depth_m + np.random.default_rng(seed).normal(0, 0.0015, depth_m.shape)
    noisy_m = np.where(np.isfinite(depth_m), noisy_m, NO_RETURN)
    return scene_data(noisy_m.astype(np.float32), INTRINSICS, seed)


def evidence(data: SceneData, shape: str) -> float:
    """Of a shape alone, in the place where another may be."""
    whole_m, window = seen(shape), data.window
    alone_m = np.where(whole_m < seen() - 1e-4, whole_m, np.inf).astype(np.float32)
    density = PixelDensity.of(window.depth_m, NOISE, SHAPE_SIGMA_M, window.stride)
    rest_m = jnp.asarray(support_depth(data.supports, window, INTRINSICS))
    shown, depth_m = density.of_object(jnp.asarray(window.of(alone_m)), rest_m)
    gain = np.where(window.inside & np.isfinite(depth_m), shown - density.of_rest(rest_m), 0.0)
    return float(gain.sum())


@pytest.mark.parametrize("shape", sorted(SHAPES))
def test_the_shape_that_is_there_is_more_probable(shape: str, seed: int) -> None:
    """By more than poses that fit alike are improbable among all."""
    assert evidence(observed(shape, seed=seed), shape) > -LOG_SHARE_OF_POSES


@pytest.mark.parametrize(
    ("thing", "asked"),
    [("box", "can"), ("can", "box"), ("box", "plank"), ("can", "ball"), ("slab", "box")],
)
def test_a_shape_in_anothers_place_is_not(thing: str, asked: str, seed: int) -> None:
    """What it explains an unknown surface explains as well."""
    assert evidence(observed(thing, seed=seed), asked) < -LOG_SHARE_OF_POSES
