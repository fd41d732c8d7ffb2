"""The summary at the end of an MCAP file: believed only where its checksum holds."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from contextlib import suppress

from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    Schema,
    Statistics,
)
from mcap.summary import Summary
from zlib_ng.zlib_ng import crc32

from recordings.mcap_files.attachments import Attachment, attachment_at
from recordings.mcap_files.chunks import payload_offset
from recordings.mcap_files.framing import (
    HEAD_SIZE,
    MAGIC,
    MAX_BLOCK_SIZE,
    NO_CRC,
    MalformedRecord,
    parse,
    record_head,
    spans,
)
from recordings.mcap_files.index import Block, FileIndex
from recordings.mcap_files.sources import Source

_FOOTER_SIZE = HEAD_SIZE + 20
_CRC_SIZE = 4


def read_summary(source: Source) -> Summary | None:
    """The summary section, or None where there is none whose checksum holds."""
    if source.size is None or source.size < len(MAGIC) + _FOOTER_SIZE + len(MAGIC):
        return None
    footer_offset = source.size - len(MAGIC) - _FOOTER_SIZE
    tail = source.read(footer_offset, _FOOTER_SIZE + len(MAGIC))
    opcode, length = record_head(tail[:HEAD_SIZE])
    if (opcode, length) != (Opcode.FOOTER, _FOOTER_SIZE - HEAD_SIZE) or not tail.endswith(MAGIC):
        return None
    footer = parse(Footer, tail[HEAD_SIZE:_FOOTER_SIZE])
    size = footer_offset - footer.summary_start
    if not 0 < size <= MAX_BLOCK_SIZE or footer.summary_start == 0 or footer.summary_crc == NO_CRC:
        return None
    section = source.read(footer.summary_start, size)
    if crc32(tail[: _FOOTER_SIZE - _CRC_SIZE], crc32(section)) != footer.summary_crc:
        return None
    try:
        return _parse_summary(section)
    except (MalformedRecord, struct.error):
        return None


def index_of_summary(source: Source, summary: Summary) -> FileIndex | None:
    """The index that a summary gives, or None where it does not list every chunk and every channel."""
    statistics = summary.statistics
    if (
        statistics is None
        or not summary.chunk_indexes
        or statistics.chunk_count != len(summary.chunk_indexes)
        or statistics.channel_count != len(summary.channels)
        or any(channel.schema_id not in {0, *summary.schemas} for channel in summary.channels.values())
    ):
        return None
    return FileIndex(
        blocks=tuple(map(_block, summary.chunk_indexes)),
        schemas=summary.schemas,
        channels=summary.channels,
        expected_messages=statistics.channel_message_counts,
        attachments=tuple(_attachments(source, summary.attachment_indexes)),
    )


def _parse_summary(section: bytes) -> Summary:
    summary = Summary()
    for opcode, start, end in spans(section):
        body = section[start:end]
        if opcode == Opcode.SCHEMA:
            schema = parse(Schema, body)
            summary.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = parse(Channel, body)
            summary.channels[channel.id] = channel
        elif opcode == Opcode.STATISTICS:
            summary.statistics = parse(Statistics, body)
        elif opcode == Opcode.CHUNK_INDEX:
            summary.chunk_indexes.append(parse(ChunkIndex, body))
        elif opcode == Opcode.ATTACHMENT_INDEX:
            summary.attachment_indexes.append(parse(AttachmentIndex, body))
    return summary


def _block(index: ChunkIndex) -> Block:
    indexed = index.message_index_length > 0
    return Block(
        offset=index.chunk_start_offset,
        payload_offset=index.chunk_start_offset + payload_offset(index.compression),
        stored_size=index.compressed_size,
        unpacked_size=index.uncompressed_size,
        compression=index.compression,
        start_time_ns=index.message_start_time,
        channel_ids=frozenset(index.message_index_offsets) if indexed else None,
        message_index_offset=index.chunk_start_offset + index.chunk_length,
        message_index_size=index.message_index_length,
    )


def _attachments(source: Source, indexes: Iterable[AttachmentIndex]) -> Iterator[Attachment]:
    """The attachments that the summary lists and that are there."""
    for index in indexes:
        with suppress(MalformedRecord):
            yield attachment_at(source, index.offset + HEAD_SIZE, index.length - HEAD_SIZE)
