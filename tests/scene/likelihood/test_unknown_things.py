"""A thing that nobody asked for is not taken for a shape that is like it, and the shape itself is."""

import jax
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from pipeline.synthesis.world import Part, RayCaster
from recordings.types import NO_RETURN, CameraIntrinsics, DepthNoise
from scene.likelihood.pixel_density import PixelDensity
from scene.likelihood.unknown_surfaces import UnknownWeights
from scene.model.number_prior import LOG_SHARE_OF_POSES
from scene.observation.frame_data import SceneData
from scene.observation.segmentation import scene_data, support_depth
from tests.scene.likelihood.whole_image import of_object

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
    placed = [(shape, standing(shape, place)) for place, shape in enumerate(shapes)]
    return view_of(placed)


def view_of(placed: list[tuple[str, NDArray[np.float64]]]) -> NDArray[np.floating]:
    """Depth (240, 320) of a table with shapes at poses world_from_shape."""
    table = Part(
        name="table", mesh=trimesh.creation.box((1.0, 1.0, 0.02)), world_from_part=moved(0, 0, -0.01)
    )
    parts = [Part(name=shape, mesh=SHAPES[shape], world_from_part=pose) for shape, pose in placed]
    return RayCaster([table, *parts]).view(INTRINSICS, camera()).depth_m


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
    return noisy(seen(*shapes), seed)


def noisy(depth_m: NDArray[np.floating], seed: int) -> SceneData:
    """What a noisy camera sees of depth (240, 320)."""
    noisy_m = depth_m + np.random.default_rng(seed).normal(0, 0.0015, depth_m.shape)
    noisy_m = np.where(np.isfinite(depth_m), noisy_m, NO_RETURN)
    return scene_data(noisy_m.astype(np.float32), INTRINSICS, seed)


def evidence(data: SceneData, shape: str) -> float:
    """Of a shape alone, in the place where another may be."""
    return evidence_at(data, shape, standing(shape, 0))


shown_by_object = jax.jit(of_object)


def evidence_at(
    data: SceneData, shape: str, pose: NDArray[np.float64], learned: UnknownWeights | None = None
) -> float:
    """The same at a pose world_from_shape, with weights of the sensor; None learns them from the image."""
    whole_m, window = view_of([(shape, pose)]), data.window
    alone_m = np.where(whole_m < seen() - 1e-4, whole_m, np.inf).astype(np.float32)
    rest_m = support_depth(data.supports, window, INTRINSICS)
    density = PixelDensity.of(window.depth_m, rest_m, NOISE, SHAPE_SIGMA_M, window.stride, learned)
    shown, depth_m = shown_by_object(density, window.of(alone_m))
    gain = np.where(np.isfinite(depth_m), shown - density.log_rest, 0.0)
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


def test_a_thing_at_the_border_leaves_the_evidence_of_others(seed: int) -> None:
    """What is told of a shape, and how sharply (the curvature over 2 mm), is the same within a twentieth.

    With one sensor's weights: the thing's outlines teach others of one image.
    """
    box, drum = ("box", standing("box", 0)), ("drum", moved(-0.37, 0.1, 0) @ standing("drum", 0))
    alone, beside = (noisy(view_of(placed), seed) for placed in ([box], [box, drum]))
    assert beside.near[:, :20].sum() > 300
    offsets_m = np.linspace(-0.002, 0.002, 9)
    poses = [moved(x, 0, 0) @ box[1] for x in offsets_m]
    learned = UnknownWeights.learned([data.window.depth_m for data in (alone, beside)], NOISE)
    logs = np.array([[evidence_at(data, "box", pose, learned) for pose in poses] for data in (alone, beside)])
    assert logs[1].max() == pytest.approx(logs[0].max(), rel=0.05)
    curvatures = np.polynomial.polynomial.polyfit(offsets_m, logs.T, 2)[2]
    assert curvatures[0] < 0
    assert curvatures[1] == pytest.approx(curvatures[0], rel=0.05)
