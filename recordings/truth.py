"""What really stood in front of the camera: a JSON topic that only `eval` and benches read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.well_known import MessageEncoding, SchemaEncoding
from numpy.typing import NDArray

from recordings.errors import RecordingError
from recordings.json_topics import json_messages
from recordings.writer import MessageSchema, RecordingWriter

TRUTH_TOPIC = "/truth/scene"

TABLE = "table"
"""Name of the support plane wherever a parent or an edge is named."""


_NUMBERS = {"type": "array", "items": {"type": "number"}}
_ROWS = {"type": ["array", "null"], "items": _NUMBERS}
_JSON_SCHEMA: Mapping[str, Any] = {
    "title": "voxscene.SceneTruth",
    "description": "Objects at rest in the world frame, the parent frame of the camera in /tf (metres).",
    "type": "object",
    "required": ["objects"],
    "properties": {
        "objects": {
            "type": "array",
            "items": {
                "type": "object",
                "required": ["name", "shape", "world_from_object"],
                "properties": {
                    "name": {"type": "string"},
                    "shape": {"description": "name of the mesh", "type": "string"},
                    "world_from_object": {"description": "4x4 rigid transform by rows", **_ROWS},
                    "vertices_m": {"description": "the mesh's corners in the object's frame", **_ROWS},
                    "faces": {"description": "triples of corners, counter-clockwise from outside", **_ROWS},
                    "parent": {"description": "what it rests on", "type": ["string", "null"]},
                    "contact_faces": {"type": ["array", "null"], "items": {"type": "string"}},
                    "visible_fraction": {
                        "description": "share of its pixels seen in the first frame",
                        "type": ["number", "null"],
                    },
                },
            },
        },
        "support_plane": {"description": "unit normal, offset", **_NUMBERS, "type": ["array", "null"]},
    },
}

_MESSAGE_SCHEMA = MessageSchema(
    name="voxscene.SceneTruth",
    encoding=SchemaEncoding.JSONSchema,
    data=json.dumps(_JSON_SCHEMA).encode(),
    message_encoding=MessageEncoding.JSON,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueObject:
    """One object of a scene, with its surface.

    Attributes:
        name: unique in its scene.
        shape: name of the mesh; instances of one mesh share it.
        world_from_object: (4, 4) float64 rigid transform.
        vertices_m: (V, 3) float64 in the object's frame; None where the recording does not bring it.
        faces: (F, 3) int32 rows of `vertices_m`, counter-clockwise from outside; None likewise.
        parent: name of what the object rests on: another object, `TABLE`, or None where it floats or
            nobody knows.
        contact_faces: the parent's and the object's own bounding-box face that lie flush, such as
            ("+z", "-x"), "+z" for the table; None where the rest is not flush.
        visible_fraction: share of the object's pixels that the first frame shows, counted in an image
            large enough to hold the whole object; None where nobody counted.
    """

    name: str
    shape: str
    world_from_object: NDArray[np.float64]
    vertices_m: NDArray[np.float64] | None = None
    faces: NDArray[np.int32] | None = None
    parent: str | None = None
    contact_faces: tuple[str, str] | None = None
    visible_fraction: float | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneTruth:
    """The objects of a recording in its world frame, the parent frame of the camera truth in /tf.

    Attributes:
        objects: every object of interest; furniture and clutter are left out.
        support_plane: (4,) unit normal and offset, n . x + d = 0 in the world frame with the normal up,
            or None where nothing supports an object.
    """

    objects: tuple[TrueObject, ...]
    support_plane: NDArray[np.float64] | None = None

    def to_json(self) -> bytes:
        """The message of `TRUTH_TOPIC`."""
        content = {
            "objects": [{key: _plain(value) for key, value in vars(o).items()} for o in self.objects],
            "support_plane": _plain(self.support_plane),
        }
        return json.dumps(content, allow_nan=False).encode()

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> SceneTruth:
        """The truth that a message of `TRUTH_TOPIC` holds.

        Raises:
            RecordingError: it holds none.
        """
        try:
            return cls(
                objects=tuple(map(_object, content["objects"])),
                support_plane=_array(content.get("support_plane"), (4,)),
            )
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise RecordingError(f"{TRUTH_TOPIC} holds no scene truth ({error!r})") from error


def write_scene_truth(writer: RecordingWriter, truth: SceneTruth, time_ns: int) -> None:
    """Write the true scene; `time_ns` is usually that of the first frame."""
    writer.write(TRUTH_TOPIC, _MESSAGE_SCHEMA, truth.to_json(), time_ns)


def recorded_scene_truth(path: Path) -> SceneTruth | None:
    """The true scene in a recording, or None where it has none.

    Raises:
        RecordingError: the recording cannot be read or its truth is malformed.
    """
    for _, content in json_messages(path, TRUTH_TOPIC):
        return SceneTruth.from_json(content)
    return None


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _object(content: Mapping[str, Any]) -> TrueObject:
    pose = _array(content["world_from_object"], (4, 4))
    if pose is None:
        raise ValueError("an object has no pose")
    vertices_m = _array(content.get("vertices_m"), (-1, 3))
    parent = content.get("parent")
    if not isinstance(parent, str | None):
        raise ValueError(f"a parent is named {parent!r}")
    return TrueObject(
        name=str(content["name"]),
        shape=str(content["shape"]),
        world_from_object=pose,
        vertices_m=vertices_m,
        faces=_faces(content.get("faces"), 0 if vertices_m is None else len(vertices_m)),
        parent=parent,
        contact_faces=_contact_faces(content.get("contact_faces")),
        visible_fraction=_share(content.get("visible_fraction")),
    )


def _faces(rows: Any, corners: int) -> NDArray[np.int32] | None:
    """Triples (F, 3) of a mesh's corners; None stays None."""
    faces = _array(rows, (-1, 3))
    if faces is None:
        return None
    if not ((faces == np.floor(faces)) & (faces >= 0) & (faces < corners)).all():
        raise ValueError(f"a face names a corner that is none of the {corners}")
    return faces.astype(np.int32)


def _contact_faces(names: Any) -> tuple[str, str] | None:
    if names is None:
        return None
    if not (isinstance(names, list) and len(names) == 2 and all(isinstance(one, str) for one in names)):
        raise ValueError(f"contact faces are two names, not {names!r}")
    return names[0], names[1]


def _share(value: Any) -> float | None:
    """A finite number; None stays None. Counted in two pictures, it may be a pixel above 1."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(float(value)):
        raise ValueError(f"a visible fraction is a number, not {value!r}")
    return value


def _array(rows: Any, shape: tuple[int, ...]) -> NDArray[np.float64] | None:
    """A finite array of `shape`, in which -1 stands for any length; None stays None."""
    if rows is None:
        return None
    array = np.array(rows, np.float64)
    matches = array.ndim == len(shape) and all(a in {-1, b} for a, b in zip(shape, array.shape, strict=True))
    if not (matches and np.isfinite(array).all()):
        raise ValueError(f"{array.shape} numbers where {shape} are due")
    return array
