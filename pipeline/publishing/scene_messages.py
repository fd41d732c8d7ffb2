"""A parsed scene in run.mcap: the objects as Foxglove shows them, and every sample of the posterior."""

from __future__ import annotations

from typing import Any

import numpy as np
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from pipeline.publishing.foxglove_geometry import REFERENCE, quaternions, set_quaternion, set_vector
from pipeline.publishing.values import RunValues
from pipeline.surfaces import Surfaces
from recordings.message_schemas import json_schema
from scene.result import SceneResult

_ROWS = {"type": "array", "items": {"type": "array"}}
SAMPLES_SCHEMA = json_schema(
    "voxscene.SceneSamples",
    {
        "description": "Samples of the posterior over scenes, in the camera of the first frame parsed.",
        "type": "object",
        "properties": {
            "names": {"type": "array", "items": {"type": "string"}},
            "poses": {"description": "[sample][object][w x y z, x y z], metres", **_ROWS},
            "parents": {
                "description": "[sample][object]: index, -1 floating, N the table, N + 1 plane_2",
                **_ROWS,
            },
            "log_posteriors": {"description": "not normalised", "type": "array"},
            "chains": {"type": "array", "items": {"type": "integer"}},
        },
    },
)
GREY = 0.75


def samples_of(scene: SceneResult) -> dict[str, Any]:
    """The message of `SAMPLES_SCHEMA`."""
    return {
        "names": scene.names.tolist(),
        "poses": scene.sample_poses.tolist(),
        "parents": scene.sample_parents.tolist(),
        "log_posteriors": scene.sample_log_posteriors.tolist(),
        "chains": scene.chain.tolist(),
    }


def scene_update(values: RunValues, scene: SceneResult, surfaces: Surfaces) -> SceneUpdate:
    """The objects that were found, as triangles in the reference frame."""
    update = SceneUpdate()
    for one in np.flatnonzero(scene.found):
        surface = surfaces.by_name[str(scene.names[one])]
        pose = values.reference_from_parsed @ scene.camera_from_object[one]
        entity = update.entities.add(frame_id=REFERENCE, id=str(scene.names[one]))
        entity.metadata.add(key="presence", value=f"{scene.presence[one]:.6f}")
        triangles = entity.triangles.add(indices=surface.faces.ravel().tolist())
        set_vector(triangles.pose.position, pose[:3, 3])
        set_quaternion(triangles.pose.orientation, quaternions(pose))
        triangles.color.r = triangles.color.g = triangles.color.b = GREY
        triangles.color.a = 1.0
        for vertex in surface.vertices_m:
            set_vector(triangles.points.add(), vertex)
    return update
