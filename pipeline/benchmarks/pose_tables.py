"""Tables of `bench poses`: objects at rest, one depth image each, and what registration peers get of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pipeline.evaluation.object_poses import model_points
from pipeline.synthesis.filming import film_table
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import TableScene
from recordings.truth import TrueObject
from recordings.types import Frame
from scene.observation.depth_view import unproject
from shapes.geometry.camera import Camera

STACKED_SHARE = 1 / 3
VISIBLE = 0.25
"""Objects of which less is seen are not judged."""
ON_TABLE_M = 0.006
MASK_M = 0.012


@dataclass(frozen=True, eq=False)
class FilmedTable:
    """One table: its recording of one frame, and that frame."""

    recording: SyntheticRecording
    frame: Frame

    @property
    def camera_from_world(self) -> NDArray[np.float64]:
        """Inverse pose (4, 4) of the camera."""
        return np.linalg.inv(self.recording.trajectory.reference_from_camera[0])

    @property
    def judged(self) -> list[TrueObject]:
        """The objects of which enough is seen."""
        return [one for one in self.recording.truth.objects if (one.visible_fraction or 0) >= VISIBLE]


def make_table(meshes: Mapping[str, trimesh.Trimesh], objects: int, seed: int) -> FilmedTable:
    """The table of a seed, the same at each call; a third of the objects are stacked where three are."""
    stacked_share = STACKED_SHARE if objects >= 1 / STACKED_SHARE else 0.0
    scene = TableScene(objects=objects, stacked_share=stacked_share, room=RoomConfig(kind="none"))
    recording = film_table(meshes, scene, seed)
    return FilmedTable(recording, next(iter(recording)))


def observed_points(
    table: FilmedTable, meshes: Mapping[str, trimesh.Trimesh], *, masked: bool
) -> list[NDArray[np.float64]]:
    """What a peer gets for each object: camera points (N, 3) over the true table plane.

    Args:
        table: where they were seen.
        meshes: by shape.
        masked: only those on the object itself, nearest to it of all objects.
    """
    camera = Camera.from_intrinsics(table.recording.intrinsics)
    points = unproject(table.frame.depth_m, camera)[table.frame.depth_m > 0]
    world = trimesh.transform_points(points, table.recording.trajectory.reference_from_camera[0])
    truth = table.recording.truth
    assert truth.support_plane is not None
    over = world @ truth.support_plane[:3] + truth.support_plane[3] > ON_TABLE_M
    if not masked:
        return [points[over]] * len(truth.objects)
    distances = np.stack(
        [
            _distance(
                meshes[one.shape], trimesh.transform_points(world, np.linalg.inv(one.world_from_object))
            )
            for one in truth.objects
        ]
    )
    owner = np.where(over & (distances.min(axis=0) < MASK_M), distances.argmin(axis=0), -1)
    return [points[owner == index] for index in range(len(truth.objects))]


def _distance(mesh: trimesh.Trimesh, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances (N,) from points to a surface, infinite far from its bounding box."""
    low, high = mesh.bounds
    near = ((points_m > low - MASK_M) & (points_m < high + MASK_M)).all(axis=1)
    distances = np.full(len(points_m), np.inf)
    if near.any():
        distances[near] = KDTree(model_points(mesh)).query(points_m[near])[0]
    return distances
