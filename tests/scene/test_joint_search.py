"""Which frames are searched, and which of the searches has each object."""

from itertools import product
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import trimesh

from pipeline.synthesis.world import Part, RayCaster
from recordings.types import NO_RETURN, CameraIntrinsics, DepthNoise
from scene.joint_search import ABSENT, best_choice, visible_fractions, worth_searching
from scene.likelihood.pixel_density import PixelDensity
from scene.observation.segmentation import scene_views
from tests.scene.observation.test_scene_views import over

PIXELS = 40


def drawn_scene(rng: np.random.Generator, places: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth (V, N, X) and gain (V, N, X): each object shows a few neighbouring pixels in each place."""
    depth_m = np.full((places, count, PIXELS), np.inf, np.float32)
    gain = np.zeros_like(depth_m)
    for place, one in np.ndindex(places, count):
        first, size = rng.integers(PIXELS - 12), rng.integers(4, 12)
        depth_m[place, one, first : first + size] = rng.uniform(0.5, 1.5)
        gain[place, one, first : first + size] = rng.normal(rng.normal(0.3, 1.0), 0.5, size)
    return depth_m, gain


def log_density(depth_m: np.ndarray, gain: np.ndarray, scene: tuple[int, ...], log_odds: np.ndarray) -> float:
    """Pixel by pixel the gain of the nearest object, and the prior odds of what is there."""
    total = sum(log_odds[place, one] for one, place in enumerate(scene) if place != ABSENT)
    for pixel in range(PIXELS):
        there = [
            (depth_m[place, one, pixel], gain[place, one, pixel])
            for one, place in enumerate(scene)
            if place != ABSENT and np.isfinite(depth_m[place, one, pixel])
        ]
        total += min(there)[1] if there else 0.0
    return float(total)


def test_the_best_choice_is_that_of_all_scenes(seed: int) -> None:
    """200 scenes of three objects and two searches against enumeration.

    One change at a time may end in a lesser top: in at most a tenth, and nowhere is a single change better.
    """
    rng, best = np.random.default_rng(seed), 0
    for _ in range(200):
        depth_m, gain = drawn_scene(rng, 2, 3)
        found, log_odds = rng.random((2, 3)) < 0.8, rng.uniform(-4.0, 0.0, (2, 3))
        options = [[ABSENT, *np.flatnonzero(found[:, one])] for one in range(3)]
        values = {
            tuple(int(place) for place in scene): log_density(depth_m, gain, scene, log_odds)
            for scene in product(*options)
        }

        chosen = tuple(best_choice(depth_m, gain, found, log_odds).tolist())

        assert all(place == ABSENT or found[place, one] for one, place in enumerate(chosen))
        changed = [other for other in values if sum(np.array(other) != np.array(chosen)) == 1]
        assert values[chosen] > max(values[other] for other in changed) - 1e-3
        best += values[chosen] > max(values.values()) - 1e-3
    assert best >= 180


INTRINSICS = CameraIntrinsics(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)


def seen(caster: RayCaster, camera: np.ndarray) -> np.ndarray:
    """Depth (H, W), 0 where nothing is."""
    depth_m = caster.view(INTRINSICS, camera).depth_m
    return np.where(np.isfinite(depth_m), depth_m, 0.0).astype(np.float32)


@pytest.mark.parametrize(
    ("blocks_m", "cameras_m", "searched"),
    [
        ((-0.9, 0.0, 0.9), (-0.9, -0.88, 0.0, 0.9), {0, 2, 3}),  # one for each block
        ((0.9,), (-0.9, 0.9), {1}),  # the first shows the bare table
        ((-0.9,), (-0.9,), {0}),
    ],
)
def test_frames_that_show_something_new_are_searched(
    blocks_m: tuple[float, ...], cameras_m: tuple[float, ...], searched: set[int]
) -> None:
    """And of what a frame shows anew no point is near to those of frames before it."""
    boxes = [("table", (3.0, 0.8, 0.02), (0.0, 0.0, -0.01))]
    boxes += [(f"block {x}", (0.1, 0.1, 0.1), (x, 0.0, 0.05)) for x in blocks_m]
    parts = [
        Part(
            name=name,
            mesh=trimesh.creation.box(size),
            world_from_part=trimesh.transformations.translation_matrix(middle),
        )
        for name, size, middle in boxes
    ]
    cameras, caster = [over(x) for x in cameras_m], RayCaster(parts)
    depths_m = [seen(caster, one) for one in cameras]
    first_camera_from_camera = np.linalg.inv(cameras[0]) @ np.stack(cameras)
    views = scene_views(depths_m, first_camera_from_camera, INTRINSICS, 1)

    chosen = worth_searching(views, first_camera_from_camera)

    assert set(chosen) == searched
    for number, view in chosen.items():
        assert view.foreground.any()
        assert not (view.foreground & ~views[number].foreground).any()


def test_frames_without_anything_say_so() -> None:
    """One line, and no search."""
    parts = [Part(name="table", mesh=trimesh.creation.box((1.0, 1.0, 0.02)), world_from_part=np.eye(4))]
    depth_m = seen(RayCaster(parts), over(0.0))
    support = (0.0, 0.0, 0.9, 0.0, -np.sin(np.pi / 2 - 0.7), -np.cos(np.pi / 2 - 0.7))
    views = scene_views([depth_m], np.eye(4)[None], INTRINSICS, 1, support=support)

    with pytest.raises(ValueError, match="nothing stands"):
        worth_searching(views, np.eye(4)[None])


def test_what_is_measured_before_an_object_hides_it() -> None:
    """As do other objects and supports; what is in the scene has a pixel at least, what is not has none."""
    layers_m = np.full((4, 8, 10), np.inf, np.float32)
    layers_m[0, :, :4] = 1.0
    layers_m[1, :4, 2:6] = 0.9  # before two of four columns of the first, in half of the rows
    layers_m[2, :, 6:] = 1.0
    layers_m[3, :, 6:] = 0.5  # not in the scene
    observed_m = np.where(np.isfinite(layers_m[:3]).any(axis=0), layers_m[:3].min(axis=0), 1.2)
    observed_m[:, 6:] = 0.8
    observed_m[:, 1] = NO_RETURN
    rest_m = np.full((8, 10), 1.2, np.float32)
    rest_m[7, :2] = 0.95
    density = PixelDensity.of(observed_m.astype(np.float32), rest_m, DepthNoise(), 0.002, 4)
    view = SimpleNamespace(window=None, rest_m=rest_m)
    compared = SimpleNamespace(camera_from_world=np.eye(4)[None], views=[view], densities=[density])
    joint = SimpleNamespace(compared=compared, frames=np.zeros(4, int))
    renderer = SimpleNamespace(layers=lambda *_: layers_m.copy())
    poses = np.tile([1.0, 0, 0, 0, 0, 0, 0], (4, 1))
    found = np.array([True, True, True, False])
    shares = visible_fractions(cast("Any", joint), cast("Any", renderer), found, poses)

    np.testing.assert_allclose(shares, [(32 - 8 - 2) / 32, 1.0, 1 / 32, 0.0])


def test_what_another_frame_than_that_of_its_search_shows_is_in_sight() -> None:
    """Moves may put an object where only a later frame shows it; what no frame shows is in none."""
    layers_m = np.full((2, 3, 8, 10), np.inf, np.float32)
    layers_m[0, 0], layers_m[1, 1] = 1.0, 1.0
    rest_m = np.full((8, 10), 1.2, np.float32)
    density = PixelDensity.of(np.ones((8, 10), np.float32), rest_m, DepthNoise(), 0.002, 4)
    views = [SimpleNamespace(window=frame, rest_m=rest_m) for frame in range(2)]
    compared = SimpleNamespace(
        camera_from_world=np.tile(np.eye(4), (2, 1, 1)), views=views, densities=[density] * 2
    )
    joint = SimpleNamespace(compared=compared, frames=np.zeros(3, int))
    renderer = SimpleNamespace(layers=lambda _numbers, _poses, window: layers_m[window].copy())
    poses = np.tile([1.0, 0, 0, 0, 0, 0, 0], (3, 1))

    shares = visible_fractions(cast("Any", joint), cast("Any", renderer), np.ones(3, bool), poses)

    np.testing.assert_allclose(shares, [1.0, 1.0, 0.0])
