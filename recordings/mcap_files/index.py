"""What an MCAP file holds and where: the common result of reading its summary and of scanning it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from mcap.opcode import Opcode
from mcap.records import Channel, MessageIndex, Schema

from recordings.mcap_files.attachments import Attachment
from recordings.mcap_files.chunks import DamagedBlock, crc_field, unpack
from recordings.mcap_files.framing import MAX_BLOCK_SIZE, NO_CRC, MalformedRecord, parse, spans
from recordings.mcap_files.sources import Source


@dataclass(frozen=True, kw_only=True)
class Block:
    """A stretch of a file that is read at once: a chunk, or a run of records outside any chunk.

    Attributes:
        offset: where the chunk's record, or the first loose record, starts in the file.
        payload_offset: where its (packed) records start; equal to `offset` for loose records.
        channel_ids: the channels that have messages in it; None where that is not known.
        message_index_offset: where the chunk's MessageIndex records stand, `message_index_size` bytes.
    """

    offset: int
    payload_offset: int
    stored_size: int
    unpacked_size: int
    compression: str
    start_time_ns: int
    channel_ids: frozenset[int] | None
    message_index_offset: int = 0
    message_index_size: int = 0

    @property
    def is_chunk(self) -> bool:
        """Whether a chunk's head, and so a checksum, precedes the payload."""
        return self.payload_offset > self.offset


@dataclass(frozen=True, kw_only=True)
class Loss:
    """A stretch of a file that cannot be used.

    Attributes:
        reason: completes the sentence "what stands at byte N ...".
        messages: how many messages of each channel were in it, as far as is known.
    """

    offset: int
    reason: str
    messages: Mapping[int, int]


@dataclass(frozen=True, kw_only=True)
class FileIndex:
    """Everything known about a file before its messages are read.

    Attributes:
        expected_messages: messages by channel that the file says it holds, under a checksum; None
            where no such statement exists.
        losses: damage met while indexing.
        definitions_verified: whether all schemas and channels stood under a checksum that held.
        loose_records_verified: the same for messages outside chunks.
        attachments: the files that the recording carries beside its messages.
    """

    blocks: tuple[Block, ...]
    schemas: Mapping[int, Schema]
    channels: Mapping[int, Channel]
    expected_messages: Mapping[int, int] | None
    losses: tuple[Loss, ...] = ()
    definitions_verified: bool = True
    loose_records_verified: bool = False
    attachments: tuple[Attachment, ...] = ()


def read_block(source: Source, block: Block) -> tuple[bytes, int]:
    """The unpacked records of a block and the checksum that they passed, `NO_CRC` where there is none.

    Raises:
        DamagedBlock: the block is cut off, larger than memory is taken for, cannot be unpacked or fails its
            checksum.
    """
    if block.stored_size > MAX_BLOCK_SIZE:
        raise DamagedBlock(f"claims {block.stored_size} bytes, more than {MAX_BLOCK_SIZE}")
    head_size = block.payload_offset - block.offset
    record = source.read(block.offset, head_size + block.stored_size)
    crc = crc_field(record) if block.is_chunk and len(record) >= head_size else NO_CRC
    return unpack(block.compression, record[head_size:], block.unpacked_size, crc), crc


def indexed_message_counts(source: Source, block: Block) -> Counter[int]:
    """Messages by channel that the MessageIndex records after a chunk list; no checksum covers them."""
    counts: Counter[int] = Counter()
    data = source.read(block.message_index_offset, block.message_index_size)
    try:
        for opcode, start, end in spans(data):
            if opcode == Opcode.MESSAGE_INDEX:
                index = parse(MessageIndex, data[start:end])
                counts[index.channel_id] += len(index.records)
    except MalformedRecord:
        pass
    return counts
