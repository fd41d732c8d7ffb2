"""Stepping from record to record in a file, and finding where sound records start again past damage."""

from __future__ import annotations

import re
from collections.abc import Callable, Container
from typing import NamedTuple

from mcap.opcode import Opcode

from recordings.mcap_files.chunks import DamagedBlock, parse_chunk_head, unpack
from recordings.mcap_files.framing import (
    HEAD_SIZE,
    MAX_BLOCK_SIZE,
    MESSAGE_HEAD_SIZE,
    NO_CRC,
    MalformedRecord,
    record_head,
)
from recordings.mcap_files.sources import Source

LONGEST_CHUNK_HEAD = 64

_WINDOW = 1 << 20
_CHAIN = 3
"""Plausible records in a row that are believed where no checksum helps."""
_CHUNK = re.compile(rb"(?=\x06.{5}\x00\x00\x00)", re.DOTALL)
_DATA_RECORD = re.compile(rb"(?=[\x03-\x0f].{5}\x00\x00\x00)", re.DOTALL)
"""Before nine bytes that could start a record: its opcode, then a length below 2^40."""


class Step(NamedTuple):
    """A record from `offset` to `end`."""

    opcode: int
    offset: int
    end: int

    @property
    def body_offset(self) -> int:
        """Where the record's body starts in the file."""
        return self.offset + HEAD_SIZE

    @property
    def body_size(self) -> int:
        """Size of the record's body."""
        return self.end - self.body_offset


def step_at(source: Source, offset: int) -> Step | None:
    """The record that starts at `offset`, or None where its length does not fit into the file."""
    head = source.read(offset, HEAD_SIZE)
    if len(head) < HEAD_SIZE:
        return None
    opcode, length = record_head(head)
    end = offset + HEAD_SIZE + length
    fits = end <= source.size if source.size is not None else length <= MAX_BLOCK_SIZE
    return Step(opcode, offset, end) if opcode != 0 and fits else None


def is_whole(source: Source, step: Step) -> bool:
    """Whether the last byte of a record is there."""
    return source.size is not None or bool(source.read(step.end - 1, 1))


def at_end(source: Source, offset: int) -> bool:
    """Whether the file has no byte at `offset`."""
    return not source.read(offset, 1)


def end_of(source: Source, offset: int) -> int:
    """The size of the file, sought from `offset` on where it is not known."""
    if source.size is not None:
        return source.size
    while piece := source.read(offset, _WINDOW):
        offset += len(piece)
    return offset


def next_sound_chunk(source: Source, offset: int) -> int | None:
    """Where the first chunk from `offset` on starts whose checksum holds."""
    return _search(source, offset, _CHUNK, lambda step: _is_sound_chunk(source, step))


def next_chain(source: Source, offset: int, channel_ids: Container[int]) -> int | None:
    """Where plausible records outside chunks start again, for messages of known channels."""
    return _search(source, offset, _DATA_RECORD, lambda step: _starts_a_chain(source, step, channel_ids))


def _search(
    source: Source, offset: int, pattern: re.Pattern[bytes], is_found: Callable[[Step], bool]
) -> int | None:
    while window := source.read(offset, _WINDOW + HEAD_SIZE):
        for match in pattern.finditer(window):
            step = step_at(source, offset + match.start())
            if step is not None and is_found(step):
                return step.offset
        offset += _WINDOW
    return None


def _is_sound_chunk(source: Source, step: Step) -> bool:
    if step.body_size > MAX_BLOCK_SIZE:
        return False
    try:
        head = parse_chunk_head(source.read(step.body_offset, LONGEST_CHUNK_HEAD), step.body_size)
        if head.crc == NO_CRC or head.unpacked_size == 0:
            return False
        payload = source.read(step.body_offset + head.payload_start, head.stored_size)
        unpack(head.compression, payload, head.unpacked_size, head.crc)
    except (MalformedRecord, DamagedBlock):
        return False
    return True


def _starts_a_chain(source: Source, step: Step, channel_ids: Container[int]) -> bool:
    for _ in range(_CHAIN):
        if step.opcode == Opcode.MESSAGE:
            channel_id = int.from_bytes(source.read(step.body_offset, 2), "little")
            if step.body_size < MESSAGE_HEAD_SIZE or channel_id not in channel_ids:
                return False
        elif step.opcode not in {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.DATA_END}:
            return False
        if step.opcode == Opcode.DATA_END or at_end(source, step.end):
            return True
        following = step_at(source, step.end)
        if following is None:
            return False
        step = following
    return True
