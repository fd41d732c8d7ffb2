"""run.mcap: the run as Foxglove's messages and as JSON with a JSON Schema. Log times are recording times."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.VoxelGrid_pb2 import VoxelGrid

from pipeline.publishing.finite import finite_json
from pipeline.publishing.foxglove_geometry import REFERENCE, quaternions, set_quaternion, set_vector
from pipeline.publishing.scene_messages import SAMPLES_SCHEMA, samples_of, scene_update
from pipeline.publishing.summary import summary_of
from pipeline.publishing.values import RunValues
from pipeline.room import RoomView
from recordings.message_schemas import json_schema, protobuf_schema
from recordings.writer import MessageSchema, RecordingWriter
from shapes.prior import ShapePrior
from slam.result import SlamResult

CAMERA = "camera"

_NUMBERS = {"type": "array", "items": {"type": ["number", "null"]}}
_FRAME_SCHEMA = json_schema(
    "voxscene.FramePosterior",
    {
        "description": "What the filter knows after a frame (metres, radians, nats).",
        "type": "object",
        "properties": {
            "frame": {"type": "integer"},
            "ess": {"type": ["number", "null"]},
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
_SUMMARY_SCHEMA = json_schema("voxscene.Summary", {"type": "object"})


def write_messages(path: Path, values: RunValues, settings: Mapping[str, Any]) -> None:
    """Write everything that a run knows as one MCAP file, whole or not at all.

    Raises:
        RecordingError: the file cannot be written.
    """
    with RecordingWriter(path) as writer:
        last_ns = 0 if values.room is None else int(values.room.times_ns[-1])
        if values.slam is not None:
            last_ns = int(values.slam.times_ns[-1])
            _write_trajectory(writer, values.slam)
        if values.room is not None:
            _write(writer, "/room/cloud", _cloud(values.room), last_ns)
        for name, shape in values.shapes.items():
            _write(writer, f"/shapes/{name}", _voxels(shape), last_ns)
        if values.scene is not None and values.surfaces is not None:
            _write(writer, "/scene/objects", scene_update(values, values.scene, values.surfaces), last_ns)
            _write_json(writer, "/scene/samples", SAMPLES_SCHEMA, samples_of(values.scene), last_ns)
        _write_json(writer, "/summary", _SUMMARY_SCHEMA, summary_of(values), last_ns)
        writer.write_metadata("voxscene", {"settings": json.dumps(settings, sort_keys=True)})


def _write_trajectory(writer: RecordingWriter, result: SlamResult) -> None:
    mean_xyzw = quaternions(result.mean)
    particles_xyzw = quaternions(result.trajectories)
    for frame, stamp in enumerate(result.times_ns):
        time_ns = int(stamp)
        camera = FrameTransform(parent_frame_id=REFERENCE, child_frame_id=CAMERA)
        set_vector(camera.translation, result.mean[frame, :3, 3])
        set_quaternion(camera.rotation, mean_xyzw[frame])
        _write(writer, "/slam/camera", camera, time_ns)
        particles = PosesInFrame(frame_id=REFERENCE)
        for pose, xyzw in zip(result.trajectories[:, frame], particles_xyzw[:, frame], strict=True):
            particle = particles.poses.add()
            set_vector(particle.position, pose[:3, 3])
            set_quaternion(particle.orientation, xyzw)
        _write(writer, "/slam/particles", particles, time_ns)
        _write_json(writer, "/slam/posterior", _FRAME_SCHEMA, _frame_posterior(result, frame), time_ns)
        if result.lost[frame]:
            text = f"frame {frame}: no pose agrees with the map"
            _write(writer, "/log", Log(level=Log.Level.WARNING, name="slam", message=text), time_ns)
    weights = {"log_weights": result.log_weights.tolist()}
    _write_json(writer, "/slam/weights", _WEIGHTS_SCHEMA, weights, int(result.times_ns[-1]))


def _frame_posterior(result: SlamResult, frame: int) -> dict[str, Any]:
    return {
        "frame": frame,
        "ess": float(result.ess[frame]),
        "log_evidence": float(result.log_evidence[frame]),
        "explained": float(result.explained[frame]),
        "resampled": bool(result.resampled[frame]),
        "lost": bool(result.lost[frame]),
        "covariance": None if result.lost[frame] else result.covariance[frame].ravel().tolist(),
        "degrees_of_freedom": float(result.degrees_of_freedom),
    }


def _cloud(room: RoomView) -> PointCloud:
    """Points as three floats and, where there is colour, four bytes."""
    columns = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    columns += [(name, "u1") for name in ("red", "green", "blue", "alpha")] if room.rgb is not None else []
    packed = np.zeros(len(room.points_m), columns)
    for axis, name in enumerate("xyz"):
        packed[name] = room.points_m[:, axis]
    if room.rgb is not None:
        for channel, name in enumerate(("red", "green", "blue")):
            packed[name] = room.rgb[:, channel]
        packed["alpha"] = 255
    cloud = PointCloud(frame_id=REFERENCE, point_stride=packed.itemsize, data=packed.tobytes())
    cloud.pose.orientation.w = 1.0
    cloud.fields.extend(_fields(packed.dtype))
    return cloud


def _voxels(shape: ShapePrior) -> VoxelGrid:
    """Probability of being occupied and the kind of each voxel, x fastest as Foxglove stores them."""
    columns, rows, slices = shape.phi.shape
    packed = np.zeros((slices, rows, columns), [("phi", "<f4"), ("seen", "u1")])
    packed["phi"] = shape.phi.transpose(2, 1, 0)
    seen = 1 * shape.seen_free + 2 * shape.seen_occupied + 3 * shape.enclosed
    packed["seen"] = seen.transpose(2, 1, 0)
    grid = VoxelGrid(
        frame_id=REFERENCE,
        row_count=rows,
        column_count=columns,
        cell_stride=packed.itemsize,
        row_stride=packed.itemsize * columns,
        slice_stride=packed.itemsize * columns * rows,
        data=packed.tobytes(),
    )
    grid.cell_size.x = grid.cell_size.y = grid.cell_size.z = shape.pitch_m
    set_vector(grid.pose.position, shape.reference_from_grid[:3, 3])
    set_quaternion(grid.pose.orientation, quaternions(shape.reference_from_grid))
    grid.fields.extend(_fields(packed.dtype))
    return grid


def _fields(dtype: np.dtype) -> list[PackedElementField]:
    kinds = {"<f4": PackedElementField.FLOAT32, "|u1": PackedElementField.UINT8}
    columns = (dtype.fields or {}).items()
    return [PackedElementField(name=name, offset=at[1], type=kinds[at[0].str]) for name, at in columns]


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
