"""Finding out what a file holds by reading all of it: for files without a trustworthy summary.

A file that was cut, or whose summary fails its checksum, is read record by record. A chunk is used if
its checksum holds. Where a record is not sound and its length leads nowhere, reading goes on at the
next chunk whose checksum holds; in a file without chunks, at the next run of plausible records.
"""

from __future__ import annotations

from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, MessageIndex, Metadata, Schema
from mcap.summary import Summary
from zlib_ng.zlib_ng import crc32

from recordings.mcap_files.attachments import Attachment, attachment_at
from recordings.mcap_files.chunks import (
    VISIBLE_SIZE,
    DamagedBlock,
    parse_chunk_head,
    unpack,
    visible_messages,
)
from recordings.mcap_files.framing import (
    MAGIC,
    MAX_BLOCK_SIZE,
    MESSAGE_HEAD_SIZE,
    NO_CRC,
    MalformedRecord,
    is_known,
    parse,
    parse_message_head,
    spans,
)
from recordings.mcap_files.index import Block, FileIndex, Loss
from recordings.mcap_files.sources import Source
from recordings.mcap_files.steps import (
    LONGEST_CHUNK_HEAD,
    Step,
    at_end,
    end_of,
    is_whole,
    next_chain,
    next_sound_chunk,
    step_at,
)

_RUN_SIZE = 1 << 20


def rebuild_index(source: Source, summary: Summary | None = None) -> FileIndex:
    """The index of a file by reading it from front to end.

    Args:
        source: the file.
        summary: a summary whose checksum held but which does not index every chunk. Its schemas,
            channels and statistics are believed before those that stand outside a checksum.
    """
    recovery = _Recovery(source, summary)
    recovery.run()
    return recovery.index()


class _Recovery:
    def __init__(self, source: Source, summary: Summary | None) -> None:
        self._source = source
        self._statistics = summary.statistics if summary else None
        self._schemas: dict[int, Schema] = dict(summary.schemas) if summary else {}
        self._channels: dict[int, Channel] = dict(summary.channels) if summary else {}
        self._proven_schemas, self._proven_channels = set(self._schemas), set(self._channels)
        self._blocks: list[Block] = []
        self._losses: list[Loss] = []
        self._attachments: list[Attachment] = []
        self._run = _Run()
        self._lost_chunk_end: int | None = None
        self._data_ended = False
        self._data_proven = False
        self._is_chunked = bool(summary and summary.statistics and summary.statistics.chunk_count)
        """Whether messages stand in chunks: what looks like one elsewhere is part of a chunk that failed."""
        self._next_chunk: int | None = 0
        """The first sound chunk from where one was last sought; None where there is none any more."""

    def index(self) -> FileIndex:
        """What was found."""
        return FileIndex(
            blocks=tuple(self._blocks),
            schemas=self._schemas,
            channels=self._channels,
            expected_messages=self._statistics.channel_message_counts if self._statistics else None,
            losses=tuple(self._losses),
            definitions_verified=self._data_proven
            or (set(self._schemas) == self._proven_schemas and set(self._channels) == self._proven_channels),
            loose_records_verified=self._data_proven,
            attachments=tuple(self._attachments),
        )

    def run(self) -> None:
        """Go through the file up to its footer, or to where nothing sound follows."""
        position = len(MAGIC)
        while True:
            step = step_at(self._source, position)
            if step is not None and (self._take(step) or self._pass_over(step)):
                if step.opcode == Opcode.FOOTER:
                    break
                position = step.end
                continue
            found = self._next_landmark(position + 1)
            if found is None:
                if not self._data_ended:
                    self._lose(position, end_of(self._source, position), "is cut off")
                break
            self._lose(position, found, "is damaged, its length too")
            position = found
        self._close_run()

    # Sound records

    def _take(self, step: Step) -> bool:
        """Use a record; False if it is not what its opcode says."""
        self._is_chunked |= step.opcode in {Opcode.CHUNK, Opcode.MESSAGE_INDEX}
        if step.opcode == Opcode.MESSAGE:
            return self._take_message(step)
        if step.opcode == Opcode.ATTACHMENT:
            return self._take_attachment(step)
        body = self._source.read(step.body_offset, min(step.body_size, MAX_BLOCK_SIZE))
        try:
            if step.opcode == Opcode.CHUNK or not is_known(step.opcode):
                self._take_chunk(step, body)
            elif step.opcode == Opcode.SCHEMA:
                self._define(parse(Schema, body), proven=False)
            elif step.opcode == Opcode.CHANNEL:
                self._define(parse(Channel, body), proven=False)
            elif step.opcode == Opcode.MESSAGE_INDEX:
                self._take_message_index(step, parse(MessageIndex, body))
            elif step.opcode == Opcode.METADATA:
                parse(Metadata, body)  # says nothing of the messages, but shows that this is no damaged chunk
            elif step.opcode == Opcode.DATA_END:
                self._take_data_end(step, parse(DataEnd, body))
            elif step.opcode == Opcode.FOOTER:
                return self._data_ended
        except (MalformedRecord, DamagedBlock):
            # A kind of record that the specification does not know (yet) is left out without loss,
            # but was tried as a chunk: one flipped bit in the opcode must not hide a chunk.
            return not is_known(step.opcode)
        return True

    def _take_attachment(self, step: Step) -> bool:
        try:
            attachment = attachment_at(self._source, step.body_offset, step.body_size)
        except MalformedRecord:
            return False
        self._attachments.append(attachment)
        return True

    def _take_message(self, step: Step) -> bool:
        head = self._source.read(step.body_offset, MESSAGE_HEAD_SIZE)
        try:
            channel_id, log_time_ns = parse_message_head(head, 0, len(head))
        except MalformedRecord:
            return False
        if (
            channel_id not in self._channels
            or step.body_size > MAX_BLOCK_SIZE
            or not is_whole(self._source, step)
        ):
            return False
        if not self._run.reaches(step):
            self._close_run()
        self._run.add(step, channel_id, log_time_ns)
        return True

    def _take_chunk(self, step: Step, body: bytes) -> None:
        head = parse_chunk_head(body[:LONGEST_CHUNK_HEAD], len(body))
        payload = body[head.payload_start : head.payload_start + head.stored_size]
        data = unpack(head.compression, payload, head.unpacked_size, head.crc)
        proven = head.crc != NO_CRC
        channel_ids: set[int] = set()
        for opcode, start, end in spans(data):
            if opcode == Opcode.SCHEMA:
                self._define(parse(Schema, data[start:end]), proven=proven)
            elif opcode == Opcode.CHANNEL:
                self._define(parse(Channel, data[start:end]), proven=proven)
            elif opcode == Opcode.MESSAGE:
                channel_ids.add(int.from_bytes(data[start : start + 2], "little"))
        self._close_run()
        self._blocks.append(
            Block(
                offset=step.offset,
                payload_offset=step.body_offset + head.payload_start,
                stored_size=head.stored_size,
                unpacked_size=head.unpacked_size,
                compression=head.compression,
                start_time_ns=head.start_time_ns,
                channel_ids=frozenset(channel_ids),
            )
        )

    def _define(self, schema_or_channel: Schema | Channel, *, proven: bool) -> None:
        """Keep a schema or channel; one under a checksum replaces one that is not."""
        record = schema_or_channel
        if isinstance(record, Schema):
            known, proven_ids = self._schemas, self._proven_schemas
        else:
            known, proven_ids = self._channels, self._proven_channels
        if record.id not in known or (proven and record.id not in proven_ids):
            known[record.id] = record  # pyright: ignore[reportArgumentType]
        if proven:
            proven_ids.add(record.id)

    def _take_message_index(self, step: Step, index: MessageIndex) -> None:
        """After a lost chunk, its message indexes tell what was in it."""
        if self._lost_chunk_end == step.offset:
            loss = self._losses[-1]
            counts = {**loss.messages, index.channel_id: len(index.records)}
            self._losses[-1] = Loss(offset=loss.offset, reason=loss.reason, messages=counts)
            self._lost_chunk_end = step.end

    def _take_data_end(self, step: Step, data_end: DataEnd) -> None:
        """Without chunks, the checksum of the whole data section is the only one there may be."""
        self._close_run()
        self._data_ended = True
        if data_end.data_section_crc == NO_CRC or any(block.is_chunk for block in self._blocks):
            return
        crc = 0
        for offset in range(0, step.offset, _RUN_SIZE):
            crc = crc32(self._source.read(offset, min(_RUN_SIZE, step.offset - offset)), crc)
        self._data_proven = crc == data_end.data_section_crc
        if not self._data_proven:
            reason = "fails the checksum of the whole file, and nothing tells which message is wrong"
            self._losses.append(Loss(offset=0, reason=reason, messages={}))

    # Damage

    def _pass_over(self, step: Step) -> bool:
        """Leave out a record that is not sound, if its length leads to another one or to the end."""
        if not is_whole(self._source, step):
            return False
        following = step_at(self._source, step.end)
        if not at_end(self._source, step.end) and (following is None or not is_known(following.opcode)):
            return False
        if step.opcode in {Opcode.CHUNK, Opcode.MESSAGE}:
            self._lose(step.offset, step.end, "is damaged")
        return True

    def _lose(self, offset: int, end: int, reason: str) -> None:
        self._close_run()
        record = self._source.read(offset, min(end - offset, VISIBLE_SIZE))
        self._is_chunked |= record[:1] == bytes([Opcode.CHUNK])
        self._losses.append(Loss(offset=offset, reason=reason, messages=visible_messages(record)))
        self._lost_chunk_end = end

    def _next_landmark(self, offset: int) -> int | None:
        """The next sound chunk; in a file that shows no chunk, the next run of plausible records."""
        if self._next_chunk is not None and self._next_chunk < offset:
            self._next_chunk = next_sound_chunk(self._source, offset)
        chunk = self._next_chunk
        if chunk is not None or self._is_chunked:
            return chunk
        return next_chain(self._source, offset, self._channels)

    def _close_run(self) -> None:
        if self._run.steps:
            self._blocks.append(self._run.block())
            self._run = _Run()


class _Run:
    """Messages that stand one after the other outside any chunk."""

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self._channel_ids: set[int] = set()
        self._start_time_ns = 0

    def reaches(self, step: Step) -> bool:
        """Whether a message continues this run without making it too long."""
        return not self.steps or (
            self.steps[-1].end == step.offset and step.end - self.steps[0].offset <= _RUN_SIZE
        )

    def add(self, step: Step, channel_id: int, log_time_ns: int) -> None:
        """Take in a message."""
        if not self.steps:
            self._start_time_ns = log_time_ns
        self.steps.append(step)
        self._channel_ids.add(channel_id)

    def block(self) -> Block:
        """The run as a block that is stored as it is."""
        offset, size = self.steps[0].offset, self.steps[-1].end - self.steps[0].offset
        return Block(
            offset=offset,
            payload_offset=offset,
            stored_size=size,
            unpacked_size=size,
            compression="",
            start_time_ns=self._start_time_ns,
            channel_ids=frozenset(self._channel_ids),
        )
