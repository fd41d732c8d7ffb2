"""What hangs in the air is improbable, by how far it is over what is below it."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from scene.model.prior import FLOATING_HEIGHT_M
from scene.objects.scene_object import SceneObject, scene_object
from scene.observation.depth_view import PooledView
from scene.observation.detection import SupportPlane
from scene.search.support_prior import UNKNOWN_CARRIER, Gravity
from scene.search.support_table import SupportTable
from shapes.geometry.poses import poses_of
from tests.scene.observation.test_detection import CAMERA_FROM_TABLE
from tests.scene.table_views import depth_of, view_of

HALF_M = np.array([0.04, 0.05, 0.03])
TABLE = SupportPlane(camera_from_table=CAMERA_FROM_TABLE, half_size_m=np.array([0.4, 0.3]), bend=np.zeros(6))
GRAVITY = Gravity(contact_sigma_m=0.005, loose_sigma_m=0.02, slack_share=0.1, floating_weight=0.02)
ABSENT = 1
BARE = view_of(depth_of([]))
"""The table with nothing on it."""


@cache
def upright_box() -> SceneObject:
    """A box of half sizes `HALF_M`."""
    mesh = trimesh.creation.box(2 * HALF_M)
    return scene_object("box", np.asarray(mesh.vertices), np.asarray(mesh.faces))


def expected(gap_m: float) -> float:
    """Log density of a gap, or of floating, over that of no gap."""

    def density(gap_m: float) -> float:
        return float(0.9 * norm.pdf(gap_m, scale=0.005) + 0.1 * norm.pdf(gap_m, scale=0.02))

    return float(np.log(max(density(gap_m), 0.02 / FLOATING_HEIGHT_M) / density(0.0)))


def all_rest(
    view: PooledView, table: SupportPlane | None, objects: Sequence[SceneObject], poses: NDArray[np.floating]
) -> SupportTable:
    """How poses rest that are all new."""
    count, places = poses.shape[:2]
    nothing = SupportTable.sure(count, places + 1)
    return GRAVITY.rests(view, table, objects, poses, np.ones((count, places), bool), nothing)


def log_rests(
    table: SupportPlane | None, *bottoms_m: tuple[float, float], view: PooledView = BARE
) -> list[float]:
    """Of boxes, alike, with places along x and heights of their bottoms; the last one is absent."""
    table_from_box = np.tile(np.eye(4), (len(bottoms_m), 1, 1))
    for pose, (x_m, bottom_m) in zip(table_from_box, bottoms_m, strict=True):
        pose[:3, 3] = [x_m, 0.0, bottom_m + HALF_M[2]]
    poses = poses_of(TABLE.camera_from_table @ table_from_box)[:, None]
    rests = all_rest(view, table, [upright_box()] * len(bottoms_m), poses)
    choice = np.append(np.zeros(len(bottoms_m) - 1, int), ABSENT)
    return [float(value) for value in rests.of(jnp.asarray(choice))]


@pytest.mark.parametrize("height_m", [0.0, 0.004, 0.012, 0.035, 0.2])
def test_boxes_over_the_table_pay_for_the_gap_or_for_floating(height_m: float) -> None:
    """By the prior's own densities; nothing beside the table, below it, or where there is none."""
    alone = [(0.0, height_m), (0.3, 0.0)]
    np.testing.assert_allclose(log_rests(TABLE, *alone), [expected(height_m), 0], atol=1e-4)
    np.testing.assert_allclose(log_rests(TABLE, (0.5, height_m), alone[1]), 0, atol=1e-4)
    np.testing.assert_allclose(log_rests(TABLE, (0.0, -height_m), alone[1]), 0, atol=1e-4)
    np.testing.assert_allclose(log_rests(None, *alone), 0)


@pytest.mark.parametrize("gap_m", [0.0, 0.004, 0.012, 0.2])
def test_boxes_rest_on_boxes_that_are_below_them_and_there(gap_m: float) -> None:
    """The upper of two pays for its gap to the lower; beside it or without it for that to the table."""
    top_m = 2 * HALF_M[2]
    upper, floats = (0.01, top_m + gap_m), expected(top_m + gap_m)
    absent = (0.3, 0.0)
    np.testing.assert_allclose(
        log_rests(TABLE, upper, (0.0, 0.0), absent), [expected(gap_m), 0, 0], atol=1e-4
    )
    np.testing.assert_allclose(log_rests(TABLE, upper, (0.2, 0.0), absent), [floats, 0, 0], atol=1e-4)
    np.testing.assert_allclose(log_rests(TABLE, upper, (0.0, 0.0)), [floats, 0], atol=1e-4)


def test_boxes_may_rest_on_a_thing_that_is_seen_though_nobody_knows_it() -> None:
    """On its top at the odds of unknown carriers, beside it not; on what is known as before."""
    low = np.array([0.06, 0.07, 0.03])
    depth_m = depth_of([(np.array([0.0, 0.0, low[2]]), low)])
    view = replace(
        BARE, unexplained=jnp.asarray(depth_m < depth_of([]) - 0.003), depth_m=jnp.asarray(depth_m)
    )
    top_m, absent = 2 * low[2], (0.3, 0.0)
    carried, beside = log_rests(TABLE, (0.01, top_m), (0.2, top_m), absent, view=view)[:2]
    assert np.log(UNKNOWN_CARRIER) - 1.0 < carried <= np.log(UNKNOWN_CARRIER)
    np.testing.assert_allclose(beside, expected(top_m), atol=1e-4)
    np.testing.assert_allclose(
        log_rests(TABLE, (0.01, top_m), (0.0, 0.0), absent, view=view)[0], 0, atol=1e-4
    )


def test_a_box_rests_by_its_edge_on_what_its_middle_is_not_over() -> None:
    """Tilted, its lowest edge over another box."""
    box = upright_box()
    tilted = trimesh.transformations.rotation_matrix(0.6, [0, 1, 0])
    points = box.points_m @ tilted[:3, :3].T
    lowest = points[points[:, 2].argmin()]
    tilted[:3, 3] = [0.03, 0.0, 2 * HALF_M[2] - lowest[2]]
    lower = np.eye(4)
    lower[:3, 3] = [np.sign(lowest[0]) * (HALF_M[0] + 0.01) + 0.03, 0.0, HALF_M[2]]
    poses = poses_of(TABLE.camera_from_table @ np.stack([tilted, lower]))[:, None]
    rests = all_rest(BARE, TABLE, [box, box], poses)
    np.testing.assert_allclose(rests.of(jnp.zeros(2, int)), 0, atol=1e-3)
    assert float(rests.of(jnp.array([0, ABSENT]))[0]) < -5


def test_poses_that_change_one_after_another_rest_as_all_at_once() -> None:
    """Seeded random poses, tilted and in each other's way, in pools of which parts are replaced twice."""
    rng = np.random.default_rng(11)
    table_from_box = np.tile(np.eye(4), (3, 6, 1, 1))
    table_from_box[..., :3, :3] = Rotation.random(18, rng=rng).as_matrix().reshape(3, 6, 3, 3)
    table_from_box[..., :3, 3] = rng.uniform([-0.08, -0.08, -0.02], [0.08, 0.08, 0.25], (3, 6, 3))
    poses = poses_of(TABLE.camera_from_table @ table_from_box)
    objects = [upright_box()] * 3
    changed = np.zeros((2, 3, 6), bool)
    changed[0, :2, 1:4] = changed[1, 1:, 2:5] = True
    then = poses.copy()
    rests = all_rest(BARE, TABLE, objects, poses)
    for part in changed:
        then[part] = poses[rng.permuted(part)]
        rests = GRAVITY.rests(BARE, TABLE, objects, then, part, rests)
    at_once = all_rest(BARE, TABLE, objects, then)
    assert np.isfinite(at_once.log_on).sum() > 30
    np.testing.assert_array_equal(rests.log_alone, at_once.log_alone)
    np.testing.assert_array_equal(rests.log_on, at_once.log_on)
