"""Files that a recording carries beside its messages: calibrations, notes, configurations."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from zlib_ng.zlib_ng import crc32

from recordings.mcap_files.framing import MAX_BLOCK_SIZE, NO_CRC, MalformedRecord
from recordings.mcap_files.sources import Source

_TIMES = struct.Struct("<QQ")  # of logging and of creation
_LENGTH = struct.Struct("<I")
_SIZE = struct.Struct("<Q")
_CRC = struct.Struct("<I")
_LONGEST_HEAD = 1 << 16


@dataclass(frozen=True, kw_only=True)
class Attachment:
    """One such file; its content stays in the recording.

    Attributes:
        offset: where the record's body starts in the recording.
        data_offset: where the content starts.
        data_size: of the content in bytes.
    """

    name: str
    media_type: str
    log_time_ns: int
    offset: int
    data_offset: int
    data_size: int


def attachment_at(source: Source, offset: int, size: int) -> Attachment:
    """The attachment whose record's body has `size` bytes from `offset`.

    Raises:
        MalformedRecord: there is none.
    """
    head = source.read(offset, min(size, _LONGEST_HEAD))
    try:
        log_time_ns, _ = _TIMES.unpack_from(head)
        name, position = _text(head, _TIMES.size)
        media_type, position = _text(head, position)
        (data_size,) = _SIZE.unpack_from(head, position)
    except (struct.error, UnicodeDecodeError) as error:
        raise MalformedRecord("not an Attachment record") from error
    position += _SIZE.size
    if position + data_size + _CRC.size > size:
        raise MalformedRecord("an attachment claims more bytes than its record has")
    return Attachment(
        name=name,
        media_type=media_type,
        log_time_ns=log_time_ns,
        offset=offset,
        data_offset=offset + position,
        data_size=data_size,
    )


def attachment_data(source: Source, attachment: Attachment) -> bytes:
    """The content.

    Raises:
        MalformedRecord: it is cut off, fails its checksum, or is too large to be held in memory.
    """
    if attachment.data_size > MAX_BLOCK_SIZE:
        raise MalformedRecord(f"the attachment {attachment.name} has {attachment.data_size} bytes")
    before = attachment.data_offset - attachment.offset
    body = source.read(attachment.offset, before + attachment.data_size + _CRC.size)
    if len(body) < before + attachment.data_size + _CRC.size:
        raise MalformedRecord(f"the attachment {attachment.name} is cut off")
    (crc,) = _CRC.unpack(body[-_CRC.size :])
    if crc not in {NO_CRC, crc32(body[: -_CRC.size])}:
        raise MalformedRecord(f"the attachment {attachment.name} fails its checksum")
    return body[before : -_CRC.size]


def _text(head: bytes, position: int) -> tuple[str, int]:
    """A string that stands after its length, and where it ends."""
    (length,) = _LENGTH.unpack_from(head, position)
    start = position + _LENGTH.size
    if start + length > len(head):
        raise struct.error("a string reaches over the end")
    return head[start : start + length].decode(), start + length
