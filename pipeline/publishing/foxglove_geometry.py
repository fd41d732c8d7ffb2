"""Poses, colours, packed points and surfaces in Foxglove's messages, and the frames of run.mcap."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

MAP = "map"
"""Same origin as `REFERENCE`, z up (REP 103, REP 105)."""
REFERENCE = "reference"
"""Frame of the run: the camera of the first depth frame that was used."""

COLOUR_FIELDS = ("red", "green", "blue", "alpha")
"""The names by which Foxglove finds the colour of a packed element."""


def quaternions(poses: NDArray[np.floating]) -> NDArray[np.float64]:
    """Rotations x, y, z, w (..., 4) of poses (..., 4, 4)."""
    flat = Rotation.from_matrix(poses[..., :3, :3].reshape(-1, 3, 3)).as_quat(canonical=True)
    return flat.reshape(*poses.shape[:-2], 4)


def set_vector(message: Any, vector: NDArray[np.floating]) -> None:
    """Fill a message that has x, y and z."""
    message.x, message.y, message.z = map(float, vector)


def set_quaternion(message: Any, xyzw: NDArray[np.float64]) -> None:
    """Fill a message that has x, y, z and w."""
    message.x, message.y, message.z, message.w = map(float, xyzw)


def set_pose(message: Any, pose: NDArray[np.float64]) -> None:
    """Fill a message that has a position and an orientation."""
    set_vector(message.position, pose[:3, 3])
    set_quaternion(message.orientation, quaternions(pose))


def set_colour(message: Any, rgb: ArrayLike) -> None:
    """Fill a message that has r, g, b and a with an opaque colour, from (3,) of 0 to 255."""
    message.r, message.g, message.b = (float(channel) / 255 for channel in np.asarray(rgb))
    message.a = 1.0


def frame_transform(parent: str, child: str, parent_from_child: NDArray[np.floating]) -> FrameTransform:
    """Where one frame (4, 4) is in another."""
    message = FrameTransform(parent_frame_id=parent, child_frame_id=child)
    set_vector(message.translation, parent_from_child[:3, 3])
    set_quaternion(message.rotation, quaternions(parent_from_child))
    return message


def point_cloud(frame: str, points_m: NDArray[np.floating], rgb: NDArray[np.uint8] | None) -> PointCloud:
    """Points (N, 3) as three floats and, where there are colours (N, 3), four bytes."""
    columns = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    columns += [(name, "u1") for name in COLOUR_FIELDS] if rgb is not None else []
    packed = np.zeros(len(points_m), columns)
    for axis, name in enumerate("xyz"):
        packed[name] = points_m[:, axis]
    if rgb is not None:
        set_packed_colour(packed, rgb, 255)
    cloud = PointCloud(frame_id=frame, point_stride=packed.itemsize, data=packed.tobytes())
    cloud.pose.orientation.w = 1.0
    cloud.fields.extend(packed_fields(packed.dtype))
    return cloud


def set_packed_colour(packed: NDArray[Any], rgb: ArrayLike, alpha: ArrayLike) -> None:
    """Fill the fields `COLOUR_FIELDS` of packed elements."""
    for channel, name in enumerate(COLOUR_FIELDS[:3]):
        packed[name] = np.asarray(rgb)[..., channel]
    packed["alpha"] = alpha


def packed_fields(dtype: np.dtype) -> list[PackedElementField]:
    """How Foxglove is to read packed elements."""
    kinds = {"<f4": PackedElementField.FLOAT32, "|u1": PackedElementField.UINT8}
    columns = (dtype.fields or {}).items()
    return [PackedElementField(name=name, offset=at[1], type=kinds[at[0].str]) for name, at in columns]


def add_triangles(
    entity: Any,
    pose: NDArray[np.float64],
    vertices_m: NDArray[np.floating],
    triangles: NDArray[np.integer],
    rgb: NDArray[np.uint8],
) -> None:
    """Add a surface to a scene entity: one colour (3,), or one for each of its vertices (V, 3)."""
    list_of = entity.triangles.add(indices=np.asarray(triangles).ravel().tolist())
    set_pose(list_of.pose, pose)
    for vertex in vertices_m:
        set_vector(list_of.points.add(), vertex)
    if rgb.ndim == 1:
        set_colour(list_of.color, rgb)
    else:
        for colour in rgb:
            set_colour(list_of.colors.add(), colour)


def add_text(
    entity: Any, position_m: NDArray[np.float64], text: str, rgb: ArrayLike, height_m: float
) -> None:
    """Add a label that faces whoever looks."""
    label = entity.texts.add(text=text, font_size=height_m, billboard=True, scale_invariant=False)
    set_vector(label.pose.position, position_m)
    label.pose.orientation.w = 1.0
    set_colour(label.color, rgb)


def add_metadata(entity: Any, values: Mapping[str, str]) -> None:
    """Add what a person may read on clicking at an entity."""
    for key, value in values.items():
        entity.metadata.add(key=key, value=value)
