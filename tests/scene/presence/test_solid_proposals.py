"""Boxes and cylinders are proposed where they stand, whatever side of them is seen."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings.types import CameraIntrinsics
from scene.observation.detection import SupportPlane
from scene.observation.segmentation import scene_data
from scene.presence.solid_proposals import _bodies, boxes_in_place, proposed_solids
from scene.presence.solids import solid_layers
from scene.presence.state_mixture import StateMixture
from shapes.geometry.camera import Camera
from shapes.geometry.poses import matrices_of, poses_of

INTRINSICS = CameraIntrinsics(width=320, height=240, fx=290.0, fy=290.0, cx=159.5, cy=119.5)
CAMERA_FROM_TABLE = np.array([[1, 0, 0, 0.02], [0, -0.6, -0.8, 0.1], [0, 0.8, -0.6, 0.8], [0, 0, 0, 1.0]])
HALF_M = np.array([[0.05, 0.03, 0.09], [0.035, 0.035, 0.05], [0.09, 0.06, 0.02]])
PLACES_M = np.array([[-0.15, 0.05, 0.09], [0.02, -0.04, 0.05], [0.2, 0.06, 0.02]])
YAWS, IS_ROUND = np.array([0.4, 0.0, -0.7]), np.array([False, True, False])


def rendered(solids: np.ndarray, is_round: np.ndarray) -> np.ndarray:
    """Depth (n, H, W) of solids (n, 10) on a table, alone."""
    poses = poses_of(CAMERA_FROM_TABLE @ matrices_of(solids[:, :7])).astype(np.float32)
    half_m = np.exp(solids[:, 7:]).astype(np.float32)
    camera = Camera.from_intrinsics(INTRINSICS)
    return solid_layers(camera, poses, half_m, is_round, 240, 320)


def seen(rng: np.random.Generator, layers_m: np.ndarray, noise_m: float) -> np.ndarray:
    """Depth (H, W) of what stands on the table, in noise."""
    columns, rows = np.meshgrid(np.arange(320), np.arange(240))
    rays = np.stack([(columns - 159.5) / 290, (rows - 119.5) / 290, np.ones_like(rows)], axis=-1)
    up, origin = CAMERA_FROM_TABLE[:3, 2], CAMERA_FROM_TABLE[:3, 3]
    table_m = (origin @ up) / (rays @ up)
    depth_m = np.minimum(layers_m.min(axis=0), table_m) + rng.normal(0, noise_m, (240, 320))
    return depth_m.astype(np.float32)


def solids_of(turns: np.ndarray, places_m: np.ndarray, half_m: np.ndarray) -> np.ndarray:
    """Solids (n, 10) of turns (n, 3), places and half sizes."""
    wxyz = Rotation.from_rotvec(turns).as_quat(scalar_first=True)
    return np.concatenate([wxyz, places_m, np.log(half_m)], axis=1)


def test_what_stands_there_is_proposed(seed: int) -> None:
    """For each of three a proposal of its kind, within 1.5 cm in its middle and in all of its faces."""
    layers_m = rendered(solids_of(YAWS[:, None] * [0.0, 0.0, 1.0], PLACES_M, HALF_M), IS_ROUND)
    depth_m = seen(np.random.default_rng(seed), layers_m, 0.0015)
    data = scene_data(depth_m, INTRINSICS, 1)
    solids, is_round = proposed_solids(data, np.linalg.inv(CAMERA_FROM_TABLE))

    for place_m, half_m, kind in zip(PLACES_M, HALF_M, IS_ROUND, strict=True):
        mine = solids[is_round == kind]
        off_m = np.linalg.norm(mine[:, 4:7] - place_m, axis=1)
        sizes_m = np.sort(np.exp(mine[:, 7:]), axis=1) - np.sort(half_m)  # axes are told in any order
        near = (off_m < 0.015) & (np.abs(sizes_m) < 0.0075).all(axis=1)
        assert near.any(), f"{place_m}: {np.round(off_m, 3)}, {np.round(sizes_m, 3)}"


def test_a_face_is_proposed_as_it_is_seen(seed: int) -> None:
    """Of a box that leans by 7 degrees, 3 mm of noise, a proposal is within 6 mm at seven pixels of ten."""
    leaning = solids_of(
        np.array([[0.12, 0, 0]]), np.array([[0.0, 0.15, 0.11]]), np.array([[0.08, 0.02, 0.1]])
    )
    layers_m = rendered(leaning, np.array([False]))
    data = scene_data(seen(np.random.default_rng(seed), layers_m, 0.003), INTRINSICS, 1)
    solids, is_round = proposed_solids(data, np.linalg.inv(CAMERA_FROM_TABLE))

    box = np.isfinite(layers_m[0])
    near = np.abs(rendered(solids, is_round)[:, box] - layers_m[0][box]) < 0.006
    assert near.mean(axis=1).max() > 0.7


@pytest.mark.parametrize("lean", [0.0, 0.1, 0.15], ids=["upright", "6 degrees", "9 degrees"])
def test_a_body_reaches_down_to_the_table(seed: int, lean: float) -> None:
    """Also far from the middle of the table: one proposal's top and foot are within 1.5 cm of a box's."""
    turns, place_m = np.array([[0.0, lean, 0]]), np.array([[-0.25, 0.05, 0.08]])
    layers_m = rendered(solids_of(turns, place_m, np.array([[0.08, 0.06, 0.08]])), np.array([False]))
    data = scene_data(seen(np.random.default_rng(seed), layers_m, 0.0015), INTRINSICS, 1)
    solids, is_round = proposed_solids(data, np.linalg.inv(CAMERA_FROM_TABLE))

    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    corners = matrices_of(solids[~is_round, :7])[:, :3, :3] @ (
        signs[None] * np.exp(solids[~is_round, None, 7:])
    ).transpose(0, 2, 1)
    heights_m = corners[:, 2] + solids[~is_round, 6, None]
    middles_m = solids[~is_round, 4:7] - place_m
    near = (np.abs(middles_m[:, 2]) < 0.015) & (np.ptp(heights_m, axis=1) > 0.13)
    assert near.any(), f"{np.round(middles_m, 3)}, {np.round(np.ptp(heights_m, axis=1), 3)}"


def test_what_carries_things_over_a_table_is_a_box() -> None:
    """From its top down to the table, turned as it is; the table itself, which is over nothing, is none."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", 0.3).as_matrix()
    pose[:3, 3] = [0.1, -0.05, 0.12]
    table = SupportPlane(
        camera_from_table=CAMERA_FROM_TABLE, half_size_m=np.array([0.4, 0.3]), bend=np.zeros(6)
    )
    block = SupportPlane(
        camera_from_table=CAMERA_FROM_TABLE @ pose, half_size_m=np.array([0.15, 0.08]), bend=np.zeros(6)
    )

    bodies = np.array(list(_bodies([table, block], np.linalg.inv(CAMERA_FROM_TABLE))))

    expected = solids_of(
        np.array([[0, 0, 0.3]]), np.array([[0.1, -0.05, 0.06]]), np.array([[0.15, 0.08, 0.06]])
    )
    np.testing.assert_allclose(bodies, expected, atol=1e-9)


def mixture_at(states: np.ndarray) -> StateMixture:
    """Objects (N,) with two places each, the second at states (N, 10), the more probable one."""
    others = states + np.array([0, 0, 0, 0, 1, 1, 1, 0, 0, 0])
    return StateMixture(
        log_weights=np.log(np.tile([0.3, 0.7], (len(states), 1))),
        centres=np.stack([others, states], axis=1),
        factors=np.tile(np.eye(9) * 0.002, (len(states), 2, 1, 1)),
        points_m=np.zeros((len(states), 3)),
        ties=np.tile(np.arange(3), (len(states), 1)),
    )


@pytest.mark.parametrize("turn", [0.0, np.pi], ids=["upright", "upside down"])
def test_a_box_where_an_object_may_be_ends_on_the_table(turn: float) -> None:
    """Of an object that reaches 4 cm below the table; not of one that leans and reaches below it too."""
    turns = np.array([[turn, 0, 0], [0.8, 0, 0]])
    objects = solids_of(turns, np.full((2, 3), [0.1, 0.2, 0.01]), np.full((2, 3), [0.03, 0.04, 0.05]))
    standing, leaning = boxes_in_place(mixture_at(objects))

    np.testing.assert_allclose(standing[4:7], [0.1, 0.2, 0.03], atol=1e-12)
    np.testing.assert_allclose(np.exp(standing[7:]), [0.03, 0.04, 0.03], atol=1e-12)
    np.testing.assert_allclose(leaning[4:], objects[1, 4:], atol=1e-12)
