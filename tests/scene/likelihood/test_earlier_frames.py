"""A frame is compared given what earlier ones measured: errors that frames share count once."""

from dataclasses import replace

import jax
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from pipeline.synthesis.world import Part, RayCaster
from recordings.types import NO_RETURN, CameraIntrinsics, DepthNoise
from scene.likelihood.earlier_frames import earlier_depths, with_earlier
from scene.likelihood.pixel_density import PixelDensity
from scene.likelihood.unknown_surfaces import UnknownWeights
from scene.observation.frame_data import SceneData
from scene.observation.segmentation import scene_data
from tests.scene.likelihood.whole_image import of_object

INTRINSICS = CameraIntrinsics(width=320, height=240, fx=280.0, fy=280.0, cx=159.5, cy=119.5)
SIZE = 60, 80
NOISE = DepthNoise(sigma_base_m=0.002, sigma_growth_per_m=0.0)


def looking_down(x_m: float) -> NDArray[np.float64]:
    """World_from_camera (4, 4) of a camera over the table, that looks straight down at x."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = x_m, 0.0, 0.8
    return pose


CAMERAS = np.stack([looking_down(x_m) for x_m in (0.0, 0.12, 0.2)])
CAMERAS_FROM_WORLD = np.asarray(np.linalg.inv(CAMERAS), np.float64)


def aside(x_m: float) -> NDArray[np.float64]:
    """World_from_camera (4, 4) of a camera beside the block at x, that looks down at it by 45 degrees."""
    forward = np.array([-np.sign(x_m), 0.0, -1.0]) / np.sqrt(2)
    right = np.array([0.0, -np.sign(x_m), 0.0])
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, np.array([x_m, 0.0, 0.55])], axis=1)
    return pose


def seen(world_from_camera: NDArray[np.float64]) -> NDArray[np.float32]:
    """What a camera sees of a block on a table, without noise."""
    parts = [
        Part(name=name, mesh=trimesh.creation.box(size), world_from_part=place)
        for name, size, place in (
            ("table", (1.4, 1.2, 0.02), trimesh.transformations.translation_matrix((0, 0, -0.01))),
            ("block", (0.1, 0.08, 0.12), trimesh.transformations.translation_matrix((0.02, 0, 0.06))),
        )
    ]
    depth_m = RayCaster(parts).view(INTRINSICS, world_from_camera).depth_m
    return np.where(np.isfinite(depth_m), depth_m, NO_RETURN).astype(np.float32)


@pytest.fixture(scope="module")
def true_m() -> list[NDArray[np.float32]]:
    """What the cameras over the table see."""
    return [seen(camera) for camera in CAMERAS]


@pytest.fixture(scope="module")
def views(true_m: list[NDArray[np.float32]]) -> list[SceneData]:
    """The same with noise."""
    rng = np.random.default_rng(0)
    noisy = [one + rng.normal(0, 0.001, one.shape).astype(np.float32) for one in true_m]
    return [scene_data(one, INTRINSICS, seed=0) for one in noisy]


def test_earlier_frames_foretell_depths(true_m: list[NDArray[np.float32]], views: list[SceneData]) -> None:
    """Where the second camera sees what the first one saw it has the depth from there, else nothing.

    Within 3 mm, six standard deviations of means of a few pixels, but at edges.
    """
    earlier_m = earlier_depths(views[:2], CAMERAS_FROM_WORLD[:2], [0, 1])
    assert (earlier_m[0] == NO_RETURN).all()
    true, told = views[1].window.of(true_m[1]), earlier_m[1] != NO_RETURN
    assert told.mean() > 0.75
    assert (np.abs(earlier_m[1] - true)[told] < 0.003).mean() > 0.98


def test_what_is_out_of_sight_is_not_foretold() -> None:
    """Behind a block a camera on its other side sees the table: it foretells nothing there but other table.

    Of the 2,000 pixels that show the block to the second camera hardly one is foretold over 2 cm behind it;
    70 would be.
    """
    sides = np.stack([aside(-0.5), aside(0.5)])
    depths_m = [seen(camera) for camera in sides]
    views = [scene_data(one, INTRINSICS, seed=0) for one in depths_m]
    told_m = earlier_depths(views, np.asarray(np.linalg.inv(sides), np.float64), [0, 1])[1]
    true = views[1].window.depth_m
    block = true < views[1].support_m - 0.01
    assert block.sum() > 100
    assert (told_m != NO_RETURN).mean() > 0.3
    assert (told_m[block] > true[block] + 0.02).mean() < 0.002


def test_the_last_frame_before_counts(views: list[SceneData]) -> None:
    """In the order given: the third frame has the second's depth where that saw it, else the first's."""
    camera_from_world = CAMERAS_FROM_WORLD
    both = earlier_depths(views, camera_from_world, [0, 1, 2])[2]
    by_first, by_second = (
        earlier_depths([views[one], views[2]], camera_from_world[[one, 2]], [0, 1])[1] for one in (0, 1)
    )
    np.testing.assert_array_equal(both, np.where(by_second == NO_RETURN, by_first, by_second))
    assert (by_second != NO_RETURN).sum() > (by_first != NO_RETURN).sum()
    assert (earlier_depths(views, camera_from_world, [2, 1, 0])[2] == NO_RETURN).all()


def test_an_error_that_two_frames_share_counts_once(seed: int) -> None:
    """What speaks against a shape with plates 4 mm too deep says less in a second frame like the first.

    Given the first at most three quarters of what it says alone, over twenty pairs; measured 0.61: the
    earlier frame has noise of its own, and its weights are those of all pixels.
    """
    rng = np.random.default_rng(seed)
    layer_m = np.full(SIZE, np.inf, np.float32)
    layer_m[10:50, 15:65] = 0.8
    wrong_m = layer_m.copy()
    for row in (15, 27, 39):
        for column in (20, 35, 50):
            wrong_m[row : row + 5, column : column + 6] += 0.004
    rest_m, true_m = np.full(SIZE, 0.95, np.float32), np.minimum(layer_m, np.float32(0.95))
    learned = UnknownWeights.learned([measured(rng, true_m)], NOISE)
    shown_by_object = jax.jit(of_object)

    def against(image_m: NDArray[np.float32], earlier_m: NDArray[np.float32] | None) -> float:
        """Nats by which an image speaks against the shape with the plates."""
        weights = learned if earlier_m is None else with_earlier(learned, [image_m], [earlier_m], NOISE)
        density = PixelDensity.of(image_m, rest_m, NOISE, 0.002, 4, weights, earlier_m)
        right, wrong = (shown_by_object(density, one)[0] for one in (layer_m, wrong_m))
        return float(np.sum(np.asarray(right - wrong)))

    alone, given = [], []
    for _ in range(20):
        first, second = measured(rng, true_m), measured(rng, true_m)
        alone.append(against(second, None))
        given.append(against(second, first))
    assert np.mean(alone) > 20
    assert np.mean(given) < 0.75 * np.mean(alone)


def test_what_earlier_frames_foretell_is_learned(seed: int) -> None:
    """Of 4,800 depths that no neighbour foretells three in five are where an earlier frame had them.

    Where no neighbour foretells the same by chance weight and scale are within 0.04 and 0.1: five of their
    standard errors (0.007, 0.02), a false alarm in 1e-6.
    """
    rng = np.random.default_rng(seed)
    depth_m = rng.uniform(0.5, 2.4, SIZE).astype(np.float32)
    seen_again = rng.random(SIZE) < 0.6
    error_m = 1.5 * NOISE.sigma_base_m * rng.standard_normal(SIZE)
    earlier_m = np.where(seen_again, depth_m - error_m, rng.uniform(0.5, 2.4, SIZE)).astype(np.float32)
    weights = with_earlier(UnknownWeights.learned([depth_m], NOISE), [depth_m], [earlier_m], NOISE)
    assert weights.earlier is not None
    assert abs(weights.earlier.weights[1] - 0.6) < 0.04
    assert abs(weights.earlier.scales[1] - 1.5) < 0.1


def test_without_earlier_frames_nothing_is_foretold(seed: int) -> None:
    """Their weights are 0."""
    depth_m = measured(np.random.default_rng(seed), np.ones(SIZE, np.float32))
    weights = UnknownWeights.learned([depth_m], NOISE)
    nothing = np.full_like(depth_m, NO_RETURN)
    earlier = with_earlier(weights, [depth_m], [nothing], NOISE).earlier
    assert earlier is not None
    assert not np.any(earlier.weights)


def test_depths_beyond_the_reach_of_a_profile_teach_nothing(seed: int) -> None:
    """A sensor's profile may tell another reach: what nothing foretells beyond it has no density."""
    rng = np.random.default_rng(seed)
    step_m = np.where(np.arange(SIZE[1]) < 40, np.float32(1.0), np.float32(2.0))
    depth_m = measured(rng, np.tile(step_m, (SIZE[0], 1)))
    earlier_m = depth_m.copy()
    earlier_m[0, 40] = 1.0
    learned = replace(UnknownWeights.learned([depth_m], NOISE), reach_m=1.5)
    earlier = with_earlier(learned, [depth_m], [earlier_m], NOISE).earlier
    assert earlier is not None
    assert np.isfinite([earlier.weights, earlier.scales]).all()


def measured(rng: np.random.Generator, true_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """An image with the sensor's noise."""
    return true_m + rng.normal(0, 0.002, true_m.shape).astype(np.float32)
