"""Unpacking chunks within the memory that they claim, and holding them against their checksums."""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass

import lz4.frame
import zstandard
from mcap.opcode import Opcode
from zlib_ng.zlib_ng import crc32

from recordings.mcap_files.framing import HEAD_SIZE, MAX_BLOCK_SIZE, MalformedRecord, record_head

VISIBLE_SIZE = 1 << 24
"""How much of damaged data is looked at."""

_SIZES = struct.Struct("<QQQII")  # message times, unpacked size, checksum, length of the compression's name
_STORED_SIZE = struct.Struct("<Q")


class DamagedBlock(Exception):  # noqa: N818  (never leaves this package)
    """A chunk cannot be unpacked or fails its checksum."""


@dataclass(frozen=True, kw_only=True)
class ChunkHead:
    """What stands before a chunk's payload; no checksum covers it."""

    start_time_ns: int
    unpacked_size: int
    crc: int
    compression: str
    stored_size: int
    payload_start: int
    """Offset of the payload in the record's body."""


def payload_offset(compression: str) -> int:
    """Offset of a chunk's payload from the start of its record."""
    return HEAD_SIZE + _SIZES.size + len(compression.encode()) + _STORED_SIZE.size


def crc_field(record: bytes) -> int:
    """The checksum in a chunk record (head included)."""
    return _SIZES.unpack_from(record, HEAD_SIZE)[3]


def parse_chunk_head(body: bytes, body_size: int) -> ChunkHead:
    """The head of a chunk from the first bytes of its body, which has `body_size` bytes in all.

    Raises:
        MalformedRecord: the sizes contradict each other.
    """
    try:
        start, _, unpacked_size, crc, name_size = _SIZES.unpack_from(body)
        name = body[_SIZES.size : _SIZES.size + name_size]
        if len(name) != name_size:
            raise MalformedRecord("the compression's name is cut off")
        (stored_size,) = _STORED_SIZE.unpack_from(body, _SIZES.size + name_size)
        compression = name.decode()
    except (struct.error, UnicodeDecodeError, OverflowError) as error:
        raise MalformedRecord("not a chunk record") from error
    payload_start = _SIZES.size + name_size + _STORED_SIZE.size
    if payload_start + stored_size > body_size:
        raise MalformedRecord(f"a chunk claims {stored_size} bytes in a record of {body_size}")
    return ChunkHead(
        start_time_ns=start,
        unpacked_size=unpacked_size,
        crc=crc,
        compression=compression,
        stored_size=stored_size,
        payload_start=payload_start,
    )


def unpack(compression: str, payload: bytes, size: int, crc: int) -> bytes:
    """The records of a chunk. `crc` 0 stands for a chunk written without a checksum.

    Raises:
        DamagedBlock: unknown compression, another size than claimed, or a checksum that fails.
    """
    if size > MAX_BLOCK_SIZE:
        raise DamagedBlock(f"claims {size} bytes unpacked, more than {MAX_BLOCK_SIZE}")
    data = _decompress(compression, payload, size)
    if len(data) != size:
        raise DamagedBlock(f"unpacks to {len(data)} bytes instead of {size}")
    if crc != 0 and crc32(data) != crc:
        raise DamagedBlock("fails its checksum")
    return data


def _decompress(compression: str, payload: bytes, size: int) -> bytes:
    if compression == "":
        return payload
    try:
        if compression == "zstd":
            claimed = zstandard.frame_content_size(payload)
            if claimed > size:
                raise DamagedBlock(f"its zstd frame claims {claimed} bytes instead of {size}")
            return zstandard.ZstdDecompressor().decompress(payload, max_output_size=size)
        if compression == "lz4":
            return lz4.frame.LZ4FrameDecompressor().decompress(payload, max_length=size)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError, ValueError) as error:
        raise DamagedBlock(f"cannot be unpacked ({compression})") from error
    raise DamagedBlock(f"has the unknown compression {compression!r}")


def visible_messages(record: bytes) -> Counter[int]:
    """Messages by channel that the beginning of a damaged or cut record shows.

    A count, never data to be used. `record` need not be given beyond `VISIBLE_SIZE` bytes.
    """
    counts: Counter[int] = Counter()
    data = record
    if record[:1] == bytes([Opcode.CHUNK]):
        try:
            head = parse_chunk_head(record[HEAD_SIZE:], MAX_BLOCK_SIZE)
        except MalformedRecord:
            return counts
        payload = record[HEAD_SIZE + head.payload_start :]
        data = _unpack_beginning(head.compression, payload, min(head.unpacked_size, VISIBLE_SIZE))
    position = 0
    while position + HEAD_SIZE + 2 <= len(data):
        opcode, length = record_head(data[position : position + HEAD_SIZE])
        if not Opcode.SCHEMA <= opcode <= Opcode.MESSAGE:
            break
        if opcode == Opcode.MESSAGE:
            counts[int.from_bytes(data[position + HEAD_SIZE : position + HEAD_SIZE + 2], "little")] += 1
        position += HEAD_SIZE + length
    return counts


def _unpack_beginning(compression: str, payload: bytes, limit: int) -> bytes:
    try:
        if compression == "zstd":
            with zstandard.ZstdDecompressor().stream_reader(payload) as reader:
                return reader.read(limit)
        if compression == "lz4":
            return lz4.frame.LZ4FrameDecompressor().decompress(payload, max_length=limit)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError, ValueError):
        return b""
    return payload[:limit]
