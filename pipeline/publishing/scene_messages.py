"""A parsed scene in run.mcap: the objects as Foxglove shows them, and every sample of the posterior."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import trimesh
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from pipeline.colours import WHITE, object_colours
from pipeline.publishing.foxglove_geometry import (
    REFERENCE,
    add_metadata,
    add_text,
    add_triangles,
    point_cloud,
)
from pipeline.publishing.told_spread import (
    agreement_text,
    label_text,
    modes_text,
    position_text,
    rotation_text,
    verdict_text,
)
from pipeline.publishing.values import RunValues
from pipeline.surfaces import Surfaces
from recordings.message_schemas import json_schema
from scene.result import SceneResult
from shapes.geometry.poses import transform_points

LETTER_M = 0.02
"""Height of a label's letters, which can be read from two metres."""
SURFACE_POINTS = 4000
"""Of each object: a point every three millimetres on a thing of the size of a hand."""

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


def samples_of(scene: SceneResult) -> dict[str, Any]:
    """The message of `SAMPLES_SCHEMA`."""
    return {
        "names": scene.names.tolist(),
        "poses": scene.sample_poses.tolist(),
        "parents": scene.sample_parents.tolist(),
        "log_posteriors": scene.sample_log_posteriors.tolist(),
        "chains": scene.chain.tolist(),
    }


def scene_update(
    values: RunValues, scene: SceneResult, surfaces: Surfaces, parse: Mapping[str, Any]
) -> SceneUpdate:
    """The objects that were found, as triangles in the reference frame, with what is told of them.

    Args:
        values: of the run.
        scene: its parsed scene.
        surfaces: of the objects.
        parse: of summary.json.
    """
    update = SceneUpdate()
    told = {one["name"]: one for one in parse["objects"]}
    for one, colour in object_colours(scene.found).items():
        name = str(scene.names[one])
        surface = surfaces.by_name[name]
        pose = values.reference_from_parsed @ scene.camera_from_object[one]
        entity = update.entities.add(frame_id=REFERENCE, id=name)
        add_triangles(entity, pose, surface.vertices_m, surface.faces, np.array(colour))
        top = pose[:3, :3] @ surface.middle_m + pose[:3, 3] + surface.radius_m * values.up
        add_text(entity, top, label_text(told[name]), WHITE, LETTER_M)
        add_metadata(entity, _metadata(told[name], parse))
    return update


def surface_points(values: RunValues, scene: SceneResult, surfaces: Surfaces) -> PointCloud:
    """Points of the found objects' surfaces in the reference frame, for viewers that draw no triangles."""
    points, colours = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    for one, colour in object_colours(scene.found).items():
        surface = surfaces.by_name[str(scene.names[one])]
        mesh = trimesh.Trimesh(surface.vertices_m, surface.faces, process=False)
        drawn = np.asarray(trimesh.sample.sample_surface(mesh, SURFACE_POINTS, seed=0)[0])
        pose = values.reference_from_parsed @ scene.camera_from_object[one]
        points.append(transform_points(pose, drawn))
        colours.append(np.tile(np.array(colour, np.uint8), (len(drawn), 1)))
    return point_cloud(REFERENCE, np.concatenate(points), np.concatenate(colours))


def _metadata(one: Mapping[str, Any], parse: Mapping[str, Any]) -> dict[str, str]:
    """What a person reads on clicking at an object."""
    rests = {edge["parent"]: edge["probability"] for edge in parse["graph"] if edge["child"] == one["name"]}
    return {
        "presence": f"{one['presence']:.6f}",
        "position": position_text(one),
        "rotation": rotation_text(one),
        "modes": modes_text(one) or "one",
        "rests on": ", ".join(f"{parent} {share:.0%}" for parent, share in rests.items()) or "nothing",
        "chains": agreement_text(one) or "converged",
        "scene": verdict_text(parse),
    }
