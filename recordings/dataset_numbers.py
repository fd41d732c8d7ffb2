"""How a data set numbers its scene, images and objects, carried along so that results can name them alike."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.well_known import MessageEncoding, SchemaEncoding

from recordings.errors import RecordingError
from recordings.json_topics import json_messages
from recordings.writer import MessageSchema, RecordingWriter

NUMBERS_TOPIC = "/dataset/numbers"

_INTEGERS = {"type": "object", "additionalProperties": {"type": "integer"}}
_JSON_SCHEMA: Mapping[str, Any] = {
    "title": "voxscene.DatasetNumbers",
    "description": "Numbers by which a data set names what this recording was made from.",
    "type": "object",
    "required": ["scene_id", "image_ids", "object_ids"],
    "properties": {
        "scene_id": {"type": "integer"},
        "image_ids": {"description": "by stamp of the frame in nanoseconds", **_INTEGERS},
        "object_ids": {"description": "by name of the object's mesh", **_INTEGERS},
    },
}
_MESSAGE_SCHEMA = MessageSchema(
    name="voxscene.DatasetNumbers",
    encoding=SchemaEncoding.JSONSchema,
    data=json.dumps(_JSON_SCHEMA).encode(),
    message_encoding=MessageEncoding.JSON,
)


@dataclass(frozen=True, kw_only=True)
class DatasetNumbers:
    """Numbers of a scene, of its images and of objects, as BOP's files use them.

    Attributes:
        scene_id: of the scene.
        image_ids: by stamp of the frame in nanoseconds.
        object_ids: by name of the object's mesh; of some objects only, perhaps.
    """

    scene_id: int = 0
    image_ids: Mapping[int, int] = field(default_factory=dict)
    object_ids: Mapping[str, int] = field(default_factory=dict)


def write_dataset_numbers(writer: RecordingWriter, numbers: DatasetNumbers, time_ns: int) -> None:
    """Write the numbers; `time_ns` is usually that of the first frame."""
    writer.write(NUMBERS_TOPIC, _MESSAGE_SCHEMA, json.dumps(vars(numbers)).encode(), time_ns)


def recorded_dataset_numbers(path: Path) -> DatasetNumbers:
    """The numbers in a recording; none where it was not made from a data set.

    Raises:
        RecordingError: the recording cannot be read, or the message is malformed.
    """
    for _, content in json_messages(path, NUMBERS_TOPIC):
        try:
            return DatasetNumbers(
                scene_id=int(content["scene_id"]),
                image_ids={int(time_ns): int(one) for time_ns, one in content["image_ids"].items()},
                object_ids={str(name): int(one) for name, one in content["object_ids"].items()},
            )
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise RecordingError(f"{path}: {NUMBERS_TOPIC} is malformed ({error!r})") from error
    return DatasetNumbers()
