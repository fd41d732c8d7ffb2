"""How MCAP frames its records: an opcode, a length, a body (https://mcap.dev/spec).

Every length is held against the bytes that are there before anything is read.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from typing import NamedTuple, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import McapRecord

MAGIC = b"\x89MCAP0\r\n"
HEAD_SIZE = 9
MAX_BLOCK_SIZE = 1 << 28
"""Largest chunk or message that is read, packed or unpacked: more is damage, or an attack on memory."""

NO_CRC = 0
"""How MCAP marks a checksum that was not written."""

MESSAGE_HEAD_SIZE = 22

_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")

Record = TypeVar("Record", bound=McapRecord)


class MalformedRecord(Exception):  # noqa: N818  (never leaves this package)
    """The bytes are not what a record of this kind looks like."""


class RecordSpan(NamedTuple):
    """Where a record's body lies in a buffer or file."""

    opcode: int
    start: int
    end: int


class _ExactStream(ReadDataStream):
    """Reads that fail where the body ends; the library's own give what is left."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) != length:
            raise EndOfFile
        return data


def record_head(head: bytes) -> tuple[int, int]:
    """Opcode and body length of the nine bytes that start a record."""
    return _HEAD.unpack(head)


def spans(data: bytes) -> Iterator[RecordSpan]:
    """The records that fill a buffer.

    Raises:
        MalformedRecord: a record reaches over the end of the buffer.
    """
    position, size = 0, len(data)
    while position < size:
        if position + HEAD_SIZE > size:
            raise MalformedRecord("a record is cut off")
        opcode, length = _HEAD.unpack_from(data, position)
        if opcode == 0:
            raise MalformedRecord("a record has the opcode 0, which is none")
        start = position + HEAD_SIZE
        position = start + length
        if position > size:
            raise MalformedRecord(f"a record claims {length} bytes where {size - start} are left")
        yield RecordSpan(opcode, start, position)


def parse_message_head(data: bytes, start: int, end: int) -> tuple[int, int]:
    """Channel id and log time of the Message record whose body lies from `start` to `end`.

    Raises:
        MalformedRecord: the body is shorter than a message's head.
    """
    if end - start < MESSAGE_HEAD_SIZE:
        raise MalformedRecord("a message record is too short")
    channel_id, _, log_time_ns, _ = _MESSAGE_HEAD.unpack_from(data, start)
    return channel_id, log_time_ns


def parse(kind: type[Record], body: bytes) -> Record:
    """A record of any other kind, by the mcap library.

    Raises:
        MalformedRecord: the body does not hold such a record.
    """
    try:
        return kind.read(_ExactStream(BytesIO(body)))  # pyright: ignore[reportAttributeAccessIssue]
    except (EndOfFile, struct.error, ValueError) as error:
        raise MalformedRecord(f"not a {kind.__name__} record") from error


def is_known(opcode: int) -> bool:
    """Whether the specification names this opcode."""
    return Opcode.HEADER <= opcode <= Opcode.DATA_END
