"""Boxes and cylinders are proposed where they stand, whatever side of them is seen."""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from recordings.types import CameraIntrinsics
from scene.observation.segmentation import scene_data
from scene.presence.solid_proposals import proposed_solids
from scene.presence.solids import solid_layers
from shapes.geometry.camera import Camera
from shapes.geometry.poses import matrices_of, poses_of

INTRINSICS = CameraIntrinsics(width=320, height=240, fx=290.0, fy=290.0, cx=159.5, cy=119.5)
CAMERA_FROM_TABLE = np.array([[1, 0, 0, 0.02], [0, -0.6, -0.8, 0.1], [0, 0.8, -0.6, 0.8], [0, 0, 0, 1.0]])
HALF_M = np.array([[0.05, 0.03, 0.09], [0.035, 0.035, 0.05], [0.09, 0.06, 0.02]])
PLACES_M = np.array([[-0.15, 0.05, 0.09], [0.02, -0.04, 0.05], [0.2, 0.06, 0.02]])
YAWS, IS_ROUND = np.array([0.4, 0.0, -0.7]), np.array([False, True, False])


def seen(rng: np.random.Generator) -> np.ndarray:
    """Depth (H, W) of the three on a table, in a millimetre and a half of noise."""
    turns = Rotation.from_rotvec(YAWS[:, None] * [0.0, 0.0, 1.0]).as_quat(scalar_first=True)
    on_table = matrices_of(np.concatenate([turns, PLACES_M], axis=1))
    poses = poses_of(CAMERA_FROM_TABLE @ on_table).astype(np.float32)
    camera = Camera.from_intrinsics(INTRINSICS)
    layers = np.asarray(
        solid_layers(camera, poses, HALF_M.astype(np.float32), jnp.asarray(IS_ROUND), 240, 320)
    )
    columns, rows = np.meshgrid(np.arange(320), np.arange(240))
    rays = np.stack([(columns - 159.5) / 290, (rows - 119.5) / 290, np.ones_like(rows)], axis=-1)
    up, origin = CAMERA_FROM_TABLE[:3, 2], CAMERA_FROM_TABLE[:3, 3]
    table_m = (origin @ up) / (rays @ up)
    return np.minimum(layers.min(axis=0), table_m) + rng.normal(0, 0.0015, (240, 320))


def test_what_stands_there_is_proposed(seed: int) -> None:
    """For each of three a proposal of its kind, within 1.5 cm in its middle and in all of its faces."""
    depth_m = seen(np.random.default_rng(seed)).astype(np.float32)
    data = scene_data(depth_m, INTRINSICS, 1)
    solids, is_round = proposed_solids(data, np.linalg.inv(CAMERA_FROM_TABLE), 12)

    assert len(solids) <= 12
    for place_m, half_m, kind in zip(PLACES_M, HALF_M, IS_ROUND, strict=True):
        mine = solids[is_round == kind]
        off_m = np.linalg.norm(mine[:, 4:7] - place_m, axis=1)
        sizes_m = np.sort(np.exp(mine[:, 7:]), axis=1) - np.sort(half_m)  # axes are told in any order
        near = (off_m < 0.015) & (np.abs(sizes_m) < 0.0075).all(axis=1)
        assert near.any(), f"{place_m}: {np.round(off_m, 3)}, {np.round(sizes_m, 3)}"


def test_an_empty_table_has_none(seed: int) -> None:
    """Noise is not a solid."""
    columns, rows = np.meshgrid(np.arange(320), np.arange(240))
    rays = np.stack([(columns - 159.5) / 290, (rows - 119.5) / 290, np.ones_like(rows)], axis=-1)
    up, origin = CAMERA_FROM_TABLE[:3, 2], CAMERA_FROM_TABLE[:3, 3]
    noise = np.random.default_rng(seed).normal(0, 0.0015, (240, 320))
    data = scene_data(((origin @ up) / (rays @ up) + noise).astype(np.float32), INTRINSICS, 1)
    solids, is_round = proposed_solids(data, np.linalg.inv(CAMERA_FROM_TABLE), 12)
    assert len(solids) == len(is_round) == 0
