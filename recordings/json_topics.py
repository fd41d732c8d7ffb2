"""Topics whose messages are plain JSON, such as posteriors, scene graphs and the truth."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.well_known import MessageEncoding

from recordings.errors import RecordingError
from recordings.mcap_files.bag import Bag


def json_messages(path: Path, topic: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """Log time in nanoseconds and content of every JSON message of a topic.

    Raises:
        RecordingError: the recording cannot be read, or a message is not a JSON object.
    """
    for message in Bag(Path(path)).messages({topic}):
        if message.topic.message_encoding == MessageEncoding.JSON:
            yield message.log_time_ns, _parse(path, topic, message.data)


def _parse(path: Path, topic: str, data: bytes) -> dict[str, Any]:
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{path}, {topic}: a message is not JSON ({error})") from error
    if not isinstance(content, dict):
        raise RecordingError(f"{path}, {topic}: a message is not a JSON object")
    return content
