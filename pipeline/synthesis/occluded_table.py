"""A box on a table, turned, wide and closer, behind which a mug may stand: after the supplement's Fig. 7."""

from __future__ import annotations

import numpy as np
import trimesh

from pipeline.synthesis.colours import muted_colour, shape_colour
from pipeline.synthesis.filming import FIRST_STAMP_NS, film_along
from pipeline.synthesis.furniture import table
from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.paths import PathConfig, camera_path
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import CameraConfig, SyntheticScene
from pipeline.synthesis.solids import surface_of
from pipeline.synthesis.world import Part
from recordings.truth import TABLE, TrueObject
from recordings.types import Trajectory

PLACES = {"turned": (75.0, 0.0), "wide": (0.0, 0.0), "closer": (0.0, 0.2)}
"""Yaw in degrees of the box, and metres by which it stands nearer to the camera."""

TABLE_M, HEIGHT_M = 0.9, 0.75
"""Side and height of the table."""

CAMERA = PathConfig(
    kind="orbit", frames=1, start_deg=-90.0, radius_m=0.9, elevations_deg=(20.0,), look_at_error_deg=0.0
)

MUG_BEHIND_M = 0.09
"""From the box's middle to the mug's where there is one."""


def occluded_table(name: str, seed: int, *, mug: bool) -> SyntheticRecording:
    """One frame of the box on the table, with a mug behind it or without.

    Args:
        name: one of PLACES.
        seed: of the sensor's noise.
        mug: whether it is there.
    """
    yaw_deg, nearer_m = PLACES[name]
    rng = np.random.default_rng([seed, 4])
    things = {"box": _standing("box", yaw_deg, -nearer_m)}
    if mug:
        things["mug"] = _standing("mug", 90.0, MUG_BEHIND_M - nearer_m)
    parts = [
        Part(name=one, mesh=built_in_object(one), world_from_part=pose, colour=shape_colour(one))
        for one, pose in things.items()
    ]
    truth = [
        TrueObject(
            name=part.name,
            shape=part.name,
            world_from_object=part.world_from_part,
            vertices_m=np.asarray(part.mesh.vertices, np.float64),
            faces=np.asarray(part.mesh.faces, np.int32),
            parent=TABLE,
        )
        for part in parts
    ]
    top = surface_of(table(TABLE_M, TABLE_M, HEIGHT_M))
    parts.append(Part(name=TABLE, mesh=top, world_from_part=np.eye(4), colour=muted_colour(rng)))
    poses = camera_path(CAMERA, np.array([0.0, 0.0, HEIGHT_M + 0.08]), rng)
    trajectory = Trajectory(times_ns=np.array([FIRST_STAMP_NS]), reference_from_camera=poses)
    scene = SyntheticScene(camera=CameraConfig(width=640, height=480), room=RoomConfig(kind="none"))
    return film_along(trajectory, scene, parts, truth, HEIGHT_M, rng, seed)


def _standing(name: str, yaw_deg: float, y_m: float) -> np.ndarray:
    """Upright on the table."""
    mesh = built_in_object(name)
    pose = trimesh.transformations.rotation_matrix(np.radians(yaw_deg), [0, 0, 1])
    pose[:3, 3] = 0.0, y_m, HEIGHT_M - mesh.bounds[0, 2]
    return pose
