"""Room that the camera does not see: against depth images of boxes, with the object and without."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.special import expit

from scene.model.presence import log_odds_of_presence, log_prior_odds
from scene.objects.scene_object import SceneObject, scene_object
from scene.observation.depth_view import PooledView
from scene.observation.detection import SupportPlane
from scene.verification.occlusion import DRAWS, PlacedObject, unseen_share
from shapes.geometry.camera import Camera
from tests.scene.observation.test_detection import CAMERA_FROM_TABLE

HALF_SIZE_M = np.array([0.3, 0.2])
WIDTH, HEIGHT, FOCAL = 160, 120, 140.0
MIDDLE_PX = np.array([79.5, 59.5])
TABLE = SupportPlane(camera_from_table=CAMERA_FROM_TABLE, half_size_m=HALF_SIZE_M, bend=np.zeros(6))
SCREEN_M = np.array([0.12, 0.02, 0.1])


def box(name: str, half_m: np.ndarray) -> SceneObject:
    """A box of this half size."""
    mesh = trimesh.creation.box(2 * half_m)
    return scene_object(name, mesh.vertices, mesh.faces)


def depth_of(boxes: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Depth (H, W) of upright boxes, middle and half size in the table's frame, on the plane z = 0: slabs."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - MIDDLE_PX[0]) / FOCAL, (v - MIDDLE_PX[1]) / FOCAL, np.ones(u.shape)], axis=-1)
    turn, origin = CAMERA_FROM_TABLE[:3, :3], -CAMERA_FROM_TABLE[:3, :3].T @ CAMERA_FROM_TABLE[:3, 3]
    rays = rays @ turn
    depth = -origin[2] / rays[..., 2]
    for middle, half in boxes:
        ends = np.sort((middle + np.array([-1, 1])[:, None] * half - origin)[:, None, None] / rays, axis=0)
        near, far = ends[0].max(axis=-1), ends[1].min(axis=-1)
        depth = np.where(near < far, np.minimum(depth, near), depth)
    return depth.astype(np.float32)


def view_of(depth_m: np.ndarray) -> PooledView:
    """The image as the search sees it."""
    camera = Camera(*(jnp.asarray(value) for value in (FOCAL, FOCAL, *MIDDLE_PX)))
    nothing = jnp.zeros(depth_m.shape, bool)
    return PooledView(camera, jnp.asarray(depth_m), jnp.zeros((*depth_m.shape, 3)), nothing)


def test_a_cube_is_unseen_where_the_image_is_the_same_without_it(seed: int) -> None:
    """A screen on the table: the share of places, by rendering the cube at 200 of them beside the screen."""
    rng = np.random.default_rng(seed)
    half = np.full(3, 0.02)
    screen = np.array([0.0, 0.0, SCREEN_M[2]]), SCREEN_M
    before = depth_of([screen])
    places = rng.uniform(-HALF_SIZE_M, HALF_SIZE_M, (600, 2))
    places = places[(np.abs(places) > SCREEN_M[:2] + 0.02 * np.sqrt(2)).any(axis=1)][:200]
    same = [(depth_of([screen, (np.append(at, 0.02), half)]) == before).mean() > 1 - 1e-4 for at in places]
    placed = np.eye(4)
    placed[2, 3] = SCREEN_M[2]

    share = unseen_share(
        rng,
        [(view_of(before), TABLE)],
        box("cube", half),
        [PlacedObject(shape=box("screen", SCREEN_M), table_from_box=placed)],
    )

    expected = np.mean(same)
    assert abs(share - expected) < 4 * np.sqrt(expected * (1 - expected) * (1 / len(same) + 1 / DRAWS))


@pytest.mark.parametrize("measured", [True, False])
def test_what_would_be_in_plain_sight_is_not_there(seed: int, measured: bool) -> None:
    """An empty table excludes a cube; an image without a measurement says nothing: the prior stays."""
    depth_m = depth_of([]) if measured else np.zeros((HEIGHT, WIDTH), np.float32)

    share = unseen_share(
        np.random.default_rng(seed), [(view_of(depth_m), TABLE)], box("cube", np.full(3, 0.02)), []
    )
    presence = expit(log_odds_of_presence([log_prior_odds(0.9)], [share], 0.9))[0]

    assert presence == pytest.approx(1e-8 if measured else 0.9, abs=1e-6)
