"""run.mcap: the run as Foxglove's messages and as JSON with a JSON Schema. Log times are recording times."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from pipeline.colours import shaded
from pipeline.publishing.camera_messages import (
    camera_transforms,
    particles_of,
    path_points,
    path_update,
    static_transform,
    view_messages,
    view_transform,
)
from pipeline.publishing.finite import finite_json
from pipeline.publishing.foxglove_geometry import REFERENCE, point_cloud
from pipeline.publishing.scene_messages import SAMPLES_SCHEMA, samples_of, scene_update, surface_points
from pipeline.publishing.shape_messages import surface_update, voxel_grid
from pipeline.publishing.summary import summary_of
from pipeline.publishing.values import RunValues
from recordings.message_schemas import json_schema, protobuf_schema
from recordings.reading import RUN_SCHEMA
from recordings.writer import MessageSchema, RecordingWriter
from slam.result import SlamResult

MEDIA_TYPES = {".npz": "application/zip", ".toml": "application/toml"}
"""Of attached values, by suffix (IANA)."""
_NUMBERS = {"type": "array", "items": {"type": ["number", "null"]}}
_FRAME_SCHEMA = json_schema(
    "voxscene.FramePosterior",
    {
        "description": "What the filter knows after a frame (metres, radians, nats).",
        "type": "object",
        "properties": {
            "frame": {"type": "integer"},
            "hypotheses": {"type": ["number", "null"]},
            "log_evidence": {"type": ["number", "null"], "description": "null where it is not finite"},
            "explained": {"type": ["number", "null"]},
            "resampled": {"type": "boolean"},
            "lost": {"type": "boolean"},
            "covariance": {
                "description": "6x6 by rows, translation first, camera axes; null where the frame is lost",
                "type": ["array", "null"],
                "items": {"type": "number"},
            },
            "degrees_of_freedom": {"description": "of a Student-t with this covariance", "type": "number"},
        },
    },
)
_WEIGHTS_SCHEMA = json_schema(
    "voxscene.ParticleWeights",
    {"type": "object", "properties": {"log_weights": {"description": "normalised", **_NUMBERS}}},
)
_SUMMARY_SCHEMA = json_schema(RUN_SCHEMA, {"type": "object"})


def write_messages(
    path: Path, values: RunValues, settings: Mapping[str, Any], files: Mapping[str, Path] | None = None
) -> None:
    """Write everything that a run knows as one MCAP file, whole or not at all.

    What holds for all of the run is stamped with its first frame, so that viewers show it from the start.

    Args:
        path: the file.
        values: of the run.
        settings: of its stages.
        files: its committed values, by the name under which each is attached.

    Raises:
        RecordingError: the file cannot be written.
    """
    with RecordingWriter(path, mends=True) as writer:
        first_ns = values.first_ns
        if values.slam is not None or values.room is not None:
            _write(writer, "/transforms/map", static_transform(values), first_ns)
            _write(writer, "/transforms/view", view_transform(values), first_ns)
        _write_whole(writer, values, first_ns)
        for time_ns, transform in camera_transforms(values):
            _write(writer, "/transforms/camera", transform, time_ns)
        if values.room is not None:
            for time_ns, topic, message in view_messages(values.room):
                _write(writer, topic, message, time_ns)
        if values.slam is not None:
            _write_filter(writer, values.slam)
        for name, file in (files or {}).items():
            writer.write_attachment(name, MEDIA_TYPES[file.suffix], file.read_bytes(), first_ns)
        writer.write_metadata("voxscene", {"settings": json.dumps(settings, sort_keys=True)})


def _write_whole(writer: RecordingWriter, values: RunValues, time_ns: int) -> None:
    """The map, the path, shapes, the scene and the summary."""
    summary = summary_of(values)
    if values.room is not None:
        room = values.room
        rgb = shaded(room.normals, values.up) if room.rgb is None else room.rgb
        _write(writer, "/room/cloud", point_cloud(REFERENCE, room.points_m, rgb), time_ns)
    if values.slam is not None:
        _write(writer, "/slam/path", path_update(values.slam), time_ns)
        _write(writer, "/slam/path/points", path_points(values.slam), time_ns)
        weights = {"log_weights": values.slam.log_weights.tolist()}
        _write_json(writer, "/slam/weights", _WEIGHTS_SCHEMA, weights, time_ns)
    for name, shape in values.shapes.items():
        _write(writer, f"/shapes/{name}", voxel_grid(shape), time_ns)
        if shape.has_surface:
            _write(writer, f"/shapes/{name}/surface", surface_update(name, shape), time_ns)
    if values.scene is not None and values.surfaces is not None:
        scene, surfaces = values.scene, values.surfaces
        _write(writer, "/scene/objects", scene_update(values, scene, surfaces, summary["parse"]), time_ns)
        _write(writer, "/scene/surfaces", surface_points(values, scene, surfaces), time_ns)
        _write_json(writer, "/scene/samples", SAMPLES_SCHEMA, samples_of(scene), time_ns)
    _write_json(writer, "/summary", _SUMMARY_SCHEMA, summary, time_ns)


def _write_filter(writer: RecordingWriter, result: SlamResult) -> None:
    """What the filter knows after each frame."""
    for frame, time_ns in enumerate(result.times_ns.tolist()):
        _write(writer, "/slam/particles", particles_of(result, frame), time_ns)
        _write_json(writer, "/slam/posterior", _FRAME_SCHEMA, _frame_posterior(result, frame), time_ns)
        if result.lost[frame]:
            text = f"frame {frame}: no pose agrees with the map"
            _write(writer, "/log", Log(level=Log.Level.WARNING, name="slam", message=text), time_ns)


def _frame_posterior(result: SlamResult, frame: int) -> dict[str, Any]:
    return {
        "frame": frame,
        "hypotheses": float(result.hypotheses[frame]),
        "log_evidence": float(result.log_evidence[frame]),
        "explained": float(result.explained[frame]),
        "resampled": bool(result.resampled[frame]),
        "lost": bool(result.lost[frame]),
        "covariance": None if result.lost[frame] else result.covariance[frame].ravel().tolist(),
        "degrees_of_freedom": float(result.degrees_of_freedom),
    }


def _write(writer: RecordingWriter, topic: str, message: Any, time_ns: int) -> None:
    """Write a Foxglove message; map entries keep one order, so that equal messages are equal bytes."""
    for stamped in message.entities if isinstance(message, SceneUpdate) else [message]:
        stamped.timestamp.FromNanoseconds(time_ns)
    data = message.SerializeToString(deterministic=True)
    writer.write(topic, protobuf_schema(type(message)), data, time_ns)


def _write_json(
    writer: RecordingWriter, topic: str, schema: MessageSchema, content: Mapping[str, Any], time_ns: int
) -> None:
    data = json.dumps(finite_json(content), allow_nan=False)
    writer.write(topic, schema, data.encode(), time_ns)
