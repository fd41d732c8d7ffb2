"""Room that the camera does not see: against depth images of boxes, with the object and without."""

import numpy as np
import pytest
import trimesh

from recordings.types import CameraIntrinsics, DepthNoise
from scene.config import ParseConfig
from scene.hidden.depth_evidence import DepthImages
from scene.hidden.hidden_objects import mean_ratio
from scene.hidden.hidden_places import DRAWS, HiddenPlaces, hidden_places, seen_image
from scene.hidden.pose_priors import PlacedObject, RestingPoses, Support
from scene.objects.scene_object import SceneObject, scene_object
from scene.observation.segmentation import scene_views
from tests.scene.observation.test_detection import CAMERA_FROM_TABLE
from tests.scene.table_views import FOCAL, HALF_SIZE_M, HEIGHT, MIDDLE_PX, WIDTH, depth_of, view_of

TABLE = Support(world_from_support=np.eye(4), half_size_m=HALF_SIZE_M)
SCREEN_M = np.array([0.12, 0.02, 0.1])
CUBE_M = np.full(3, 0.02)


def box(name: str, half_m: np.ndarray) -> SceneObject:
    """A box of this half size."""
    mesh = trimesh.creation.box(2 * half_m)
    return scene_object(name, mesh.vertices, mesh.faces)


def images_of(depth_m: np.ndarray, placed: list[PlacedObject]) -> DepthImages:
    """The image as the parse sees it."""
    image = seen_image(view_of(depth_m), CAMERA_FROM_TABLE, placed, 1.0)
    return DepthImages([image], DepthNoise(outlier_probability=0.1))


def test_a_cube_is_hidden_where_the_image_is_the_same_without_it(seed: int) -> None:
    """A screen on the table: the share of places, by slabs of the cube at 300 of them beside the screen."""
    rng = np.random.default_rng(seed)
    screen = np.array([0.0, 0.0, SCREEN_M[2]]), SCREEN_M
    before = depth_of([screen])
    places = rng.uniform(-HALF_SIZE_M, HALF_SIZE_M, (600, 2))
    places = places[(np.abs(places) > SCREEN_M[:2] + 0.02 * np.sqrt(2)).any(axis=1)][:300]
    after = [depth_of([screen, (np.append(at, 0.02), CUBE_M)]) for at in places]
    same = [(one == before).mean() > 1 - 1e-4 for one in after]
    placed = np.eye(4)
    placed[2, 3] = SCREEN_M[2]
    known = [PlacedObject(shape=box("screen", SCREEN_M), world_from_box=placed)]
    images = images_of(before, known)
    prior = RestingPoses(supports=(TABLE,), others=tuple(known), in_sight=images.seen)

    ratio = mean_ratio(rng, [box("cube", CUBE_M)], prior, images, draws=DRAWS, keep=64)

    expected = np.mean(same)
    error = np.hypot(ratio.standard_error, np.sqrt(expected * (1 - expected) / len(same)))
    assert abs(ratio.mean - expected) < 4 * error
    behind = ratio.poses[0, :, 1, 3] * np.sign(CAMERA_FROM_TABLE[2, 1])
    assert (behind > 0).mean() > 0.8


@pytest.mark.parametrize("measured", [True, False])
def test_what_would_be_in_plain_sight_is_not_there(seed: int, measured: bool) -> None:
    """An empty table excludes a cube; an image without a measurement says nothing: the prior stays."""
    depth_m = depth_of([]) if measured else np.zeros((HEIGHT, WIDTH), np.float32)
    images = images_of(depth_m, [])
    prior = RestingPoses(supports=(TABLE,), in_sight=images.seen)

    ratio = mean_ratio(np.random.default_rng(seed), [box("cube", CUBE_M)], prior, images, draws=DRAWS, keep=1)
    presence = 0.9 * ratio.mean / (0.9 * ratio.mean + 0.1)

    assert presence == pytest.approx(1e-8 if measured else 0.9, abs=1e-6)


def test_an_error_of_the_sensor_behind_a_found_object_gives_nothing_away(seed: int) -> None:
    """Pixels that look through the screen, one in ten, leave a cube behind it where it may be."""
    rng = np.random.default_rng(seed)
    screen = np.array([0.0, 0.0, SCREEN_M[2]]), SCREEN_M
    clean, wall = depth_of([screen]), depth_of([])
    holes = (rng.uniform(size=clean.shape) < 0.1) & (clean < wall)
    placed = np.eye(4)
    placed[2, 3] = SCREEN_M[2]
    known = [PlacedObject(shape=box("screen", SCREEN_M), world_from_box=placed)]
    behind = np.eye(4)[None]
    behind[0, :3, 3] = 0.0, 0.06 * np.sign(CAMERA_FROM_TABLE[2, 1]), 0.02

    ratio = images_of(np.where(holes, wall, clean), known).log_ratios(box("cube", CUBE_M), behind)
    naked = images_of(np.where(holes, wall, clean), []).log_ratios(box("cube", CUBE_M), behind)

    assert abs(ratio[0]) < 1e-3
    assert naked[0] < -10


def _places(placed: dict[int, PlacedObject], seed: int) -> HiddenPlaces:
    """Of a screen and a cube, where the image shows the screen alone."""
    depth_m = depth_of([(np.array([0.0, 0.0, SCREEN_M[2]]), SCREEN_M)])
    camera = CameraIntrinsics(
        width=WIDTH, height=HEIGHT, fx=FOCAL, fy=FOCAL, cx=MIDDLE_PX[0], cy=MIDDLE_PX[1]
    )
    return hidden_places(
        np.random.default_rng(seed),
        scene_views([depth_m], np.eye(4)[None], camera, 0, (), ()),
        CAMERA_FROM_TABLE[None],
        [TABLE],
        [box("screen", SCREEN_M), box("cube", CUBE_M)],
        placed,
        DepthNoise(outlier_probability=0.1),
        ParseConfig(),
    )


def test_what_was_found_may_be_out_of_sight_all_the_same(seed: int) -> None:
    """What the search took for the cube, before the screen, tells nothing of whether it stands behind.

    Shares of 512 draws each; five standard errors are exceeded by one in a million.
    """
    on_table, before = np.eye(4), np.eye(4)
    on_table[2, 3] = SCREEN_M[2]
    before[:3, 3] = 0.0, -0.1 * np.sign(CAMERA_FROM_TABLE[2, 1]), CUBE_M[2]
    screen = PlacedObject(shape=box("screen", SCREEN_M), world_from_box=on_table)
    cube = PlacedObject(shape=box("cube", CUBE_M), world_from_box=before)

    without, with_it = _places({0: screen}, seed), _places({0: screen, 1: cube}, seed)

    error = np.hypot(without.share_std[1], with_it.share_std[1])
    assert without.share[1] > 0.02
    assert abs(without.share[1] - with_it.share[1]) < 5 * error
    assert without.share[0] < 1e-3  # the screen would be seen anywhere


def test_what_has_no_room_is_not_out_of_sight(seed: int) -> None:
    """Where a screen as large as the table stands on it, neither of them is anywhere else."""
    filling = box("filling", np.append(HALF_SIZE_M, 0.05))
    middle = np.eye(4)
    middle[2, 3] = 0.05

    places = _places({0: PlacedObject(shape=filling, world_from_box=middle)}, seed)

    assert places.share[1] == 0.0
