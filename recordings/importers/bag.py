"""ROS 1 bags and ROS 2 bags of any storage, by rosbags: their images, cameras, clouds and poses."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mcap.well_known import MessageEncoding, SchemaEncoding

from recordings.depth_units import is_depth_unit
from recordings.errors import RecordingError
from recordings.messages.ros2 import READABLE_TYPES, canonical_name
from recordings.messages.ros2_standard import cdr_from_ros1, standard_definition
from recordings.writer import MessageSchema, RecordingWriter

_LAST_STAMP_NS = (1 << 63) - 1


def import_bag(source: Path, out: Path, progress: Callable[[int, int], None]) -> tuple[str, ...]:
    """Copy a bag's messages that a recording can use into an MCAP file, pixel for pixel.

    Args:
        source: a ROS 1 `.bag` file, a rosbag2 folder, or a lone `.db3` or `.mcap` file of ROS 2.
        out: the MCAP file to write.
        progress: is told how many messages of how many are copied.

    Returns:
        Sentences on what was left out.

    Raises:
        RecordingError: the bag is damaged or holds nothing of use, or `out` cannot be written.
    """
    if not source.exists():
        raise RecordingError(f"cannot read {source}: No such file or directory")
    with _opened(source) as (bag, is_ros1):
        wanted = [c for c in bag.connections if _is_used(c)]
        if not wanted:
            types = ", ".join(sorted({canonical_name(c.msgtype) for c in bag.connections})) or "nothing"
            raise RecordingError(f"{source} holds no images, point clouds or poses; it holds {types}")
        total = sum(connection.msgcount for connection in wanted)
        with RecordingWriter(out, profile="ros2") as writer:
            for count, (connection, time_ns, data) in enumerate(bag.messages(connections=wanted), 1):
                name = canonical_name(connection.msgtype)
                content = cdr_from_ros1(data, name) if is_ros1 else bytes(data)
                writer.write(connection.topic, _schema(name), content, min(max(time_ns, 0), _LAST_STAMP_NS))
                progress(count, total)
        left_out = sorted({c.topic for c in bag.connections} - {c.topic for c in wanted})
    return (f"left out, of types that a recording does not use: {', '.join(left_out)}",) if left_out else ()


@contextmanager
def _opened(source: Path) -> Iterator[tuple[Any, bool]]:
    """The rosbags reader of a bag; whatever it raises on a damaged bag becomes one clear line."""
    is_ros1 = source.suffix == ".bag"
    try:
        if is_ros1:
            from rosbags.rosbag1 import Reader
        else:
            from rosbags.rosbag2 import Reader
        with Reader(source) as bag:
            yield bag, is_ros1
    except RecordingError:
        raise
    except Exception as error:  # a reader of foreign files raises all kinds on damage
        raise RecordingError(f"cannot read {source} as a bag: {error or type(error).__name__}") from error


def _is_used(connection: Any) -> bool:
    """Whether a recording can use a connection's messages; of numbers the unit of depth alone."""
    kind = canonical_name(connection.msgtype)
    return kind in READABLE_TYPES and (kind != "std_msgs/msg/Float32" or is_depth_unit(connection.topic))


def _schema(name: str) -> MessageSchema:
    return MessageSchema(
        name=name,
        encoding=SchemaEncoding.ROS2,
        data=standard_definition(name).encode(),
        message_encoding=MessageEncoding.CDR,
    )
