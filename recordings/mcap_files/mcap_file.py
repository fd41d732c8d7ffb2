"""One MCAP file: its channels, its messages in the order of time, and what of it is lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode

from recordings.errors import RecordingError
from recordings.mcap_files.block_reader import BlockCache, read_blocks
from recordings.mcap_files.framing import (
    MAGIC,
    MESSAGE_HEAD_SIZE,
    NO_CRC,
    MalformedRecord,
    parse_message_head,
    spans,
)
from recordings.mcap_files.index import Block, FileIndex, Loss, indexed_message_counts
from recordings.mcap_files.recovery import rebuild_index
from recordings.mcap_files.sources import Source, open_source
from recordings.mcap_files.summary import index_of_summary, read_summary

SECOND_NS = 1_000_000_000
_MAGIC_BYTES_THAT_MAY_BE_WRONG = 2
_OTHER_FILES = {
    b"#ROSBAG": "but a ROS 1 bag; convert it with: voxscene import bag {path} OUT.mcap",
    b"SQLite": "but a rosbag2 file in SQLite; convert it with: voxscene import bag {path} OUT.mcap",
    b"\x1f\x8b": "but packed with gzip; unpack it first",
    b"PK": "but a zip archive; unpack it first",
}
"""What a file that starts so is, and what to do with it."""


@dataclass(frozen=True)
class Topic:
    """What the messages of a channel are: enough to find their decoder."""

    name: str
    message_encoding: str
    schema_name: str
    schema_encoding: str
    schema_data: bytes


class Message(NamedTuple):
    """One message of a recording, not decoded."""

    topic: Topic
    log_time_ns: int
    data: bytes


class McapFile:
    """An MCAP file, whole or damaged, that is read as often as one likes.

    Chunks that fail their checksum are left out and counted. Where the file's summary cannot be
    trusted, the whole file is read once to find out what is in it.

    Raises:
        RecordingError: the file cannot be read or is no MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_source(path) as source:
            _check_magic(path, source)
            self.index = _index(source)
        self._blocks = sorted(self.index.blocks, key=lambda block: (block.start_time_ns, block.offset))
        self._topics = {
            channel.id: _topic(self.index, channel.id) for channel in self.index.channels.values()
        }
        self._losses = {loss.offset: loss for loss in self.index.losses}
        self._missing: Counter[int] = Counter()
        self._unverified = not self.index.definitions_verified
        self.cache = BlockCache(size=0)

    @property
    def topics(self) -> set[Topic]:
        """What the file's channels carry."""
        return set(self._topics.values())

    @property
    def losses(self) -> tuple[Loss, ...]:
        """The stretches found unusable so far, in the order of the file."""
        return tuple(self._losses[offset] for offset in sorted(self._losses))

    @property
    def lost_messages(self) -> int:
        """Messages known to be lost so far."""
        in_losses: Counter[int] = Counter()
        for loss in self._losses.values():
            in_losses.update(loss.messages)
        return (in_losses | self._missing).total()

    @property
    def verified(self) -> bool:
        """Whether everything read so far stood under a checksum that held."""
        return not self._unverified

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """The messages of the named topics, or of all: chunks by log time, each in its own order."""
        wanted = {id_ for id_, topic in self._topics.items() if topics is None or topic.name in topics}
        # Blocks with a channel that is nowhere defined are read too, so that their messages count as lost.
        blocks = [
            block
            for block in self._blocks
            if block.channel_ids is None
            or not wanted.isdisjoint(block.channel_ids)
            or not self._topics.keys() >= block.channel_ids
        ]
        counts: Counter[int] = Counter()
        broken: list[tuple[Block, Counter[int]]] = []
        with open_source(self.path) as source:
            for block, records in read_blocks(source, blocks, self.cache):
                if isinstance(records, Loss):
                    self._losses[block.offset] = records
                    continue
                data, crc = records
                if crc == NO_CRC and (block.is_chunk or not self.index.loose_records_verified):
                    self._unverified = True
                found: Counter[int] = Counter()
                try:
                    for channel_id, log_time_ns, start, end in _message_spans(data):
                        found[channel_id] += 1
                        if channel_id in wanted:
                            yield Message(self._topics[channel_id], log_time_ns, data[start:end])
                except MalformedRecord as error:
                    loss = Loss(offset=block.offset, reason=str(error), messages={})
                    self._losses.setdefault(block.offset, loss)
                    broken.append((block, found))
                counts += found
            # Counted now that no block is read ahead from the same file.
            for block, found in broken:
                lost = indexed_message_counts(source, block) - found
                self._losses[block.offset] = replace(self._losses[block.offset], messages=lost)
        self._compare_counts(wanted, counts)

    def log_steps_back_s(self, topic: str) -> list[float]:
        """Where, in seconds after its first block, a topic's log time steps back from block to block.

        Recorders write a topic in the order in which it came: their clock was set back there.
        """
        ids = {id_ for id_, known in self._topics.items() if known.name == topic}
        starts_ns = [
            block.start_time_ns
            for block in sorted(self.index.blocks, key=lambda block: block.offset)
            if block.channel_ids is None or not ids.isdisjoint(block.channel_ids)
        ]
        return [
            (before - starts_ns[0]) / SECOND_NS for before, start in pairwise(starts_ns) if start < before
        ]

    def _compare_counts(self, wanted: set[int], counts: Counter[int]) -> None:
        """Hold what a complete pass gave against what the file says it holds."""
        strangers = set(counts) - set(self._topics)
        for channel_id in strangers:
            self._missing[channel_id] = counts[channel_id]
        for channel_id in wanted:
            expected = (self.index.expected_messages or {}).get(channel_id, 0)
            self._missing[channel_id] = max(0, expected - counts[channel_id])


def _message_spans(data: bytes) -> Iterator[tuple[int, int, int, int]]:
    """Channel id, log time and place of the content of every message in a block."""
    for opcode, start, end in spans(data):
        if opcode == Opcode.MESSAGE:
            yield *parse_message_head(data, start, end), start + MESSAGE_HEAD_SIZE, end


def _index(source: Source) -> FileIndex:
    summary = read_summary(source)
    index = index_of_summary(source, summary) if summary else None
    return index or rebuild_index(source, summary)


def _topic(index: FileIndex, channel_id: int) -> Topic:
    channel = index.channels[channel_id]
    schema = index.schemas.get(channel.schema_id)
    return Topic(
        name=channel.topic,
        message_encoding=channel.message_encoding,
        schema_name=schema.name if schema else "",
        schema_encoding=schema.encoding if schema else "",
        schema_data=schema.data if schema else b"",
    )


def _check_magic(path: Path, source: Source) -> None:
    """A file is an MCAP file if its first eight bytes say so; two of them may be damaged."""
    magic = source.read(0, len(MAGIC))
    if not magic:
        is_packed = path.stat().st_size > 0
        raise RecordingError(f"{path} is {'no zstd file, or cut off at its start' if is_packed else 'empty'}")
    wrong = sum(a != b for a, b in zip(magic, MAGIC, strict=False)) + len(MAGIC) - len(magic)
    if wrong > _MAGIC_BYTES_THAT_MAY_BE_WRONG:
        raise RecordingError(f"{path} is not an MCAP file ({_what_it_is(path, magic)})")


def _what_it_is(path: Path, magic: bytes) -> str:
    for start, advice in _OTHER_FILES.items():
        if magic.startswith(start):
            return advice.format(path=path)
    return f"it starts with {magic!r}"
