"""Reading the blocks of a file ahead of their use, and keeping the last ones for other readers."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Lock

from recordings.mcap_files.chunks import DamagedBlock
from recordings.mcap_files.index import Block, Loss, indexed_message_counts, read_block
from recordings.mcap_files.sources import Source

Records = tuple[bytes, int]
"""The unpacked records of a block and the checksum that they passed."""


class BlockCache:
    """The blocks read last, up to a number of bytes but always one; shared between threads."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._blocks: OrderedDict[int, Records] = OrderedDict()
        self._lock = Lock()

    def get(self, offset: int) -> Records | None:
        """The block that starts at an offset, if it is kept."""
        with self._lock:
            return self._blocks.get(offset)

    def put(self, offset: int, records: Records) -> None:
        """Keep a block, and let go of the oldest that are too much."""
        with self._lock:
            self._blocks[offset] = records
            held = sum(len(data) for data, _ in self._blocks.values())
            while held > self.size and len(self._blocks) > 1:
                _, (data, _) = self._blocks.popitem(last=False)
                held -= len(data)


def read_blocks(
    source: Source, blocks: Sequence[Block], cache: BlockCache
) -> Iterator[tuple[Block, Records | Loss]]:
    """Each block and its records, or why they are lost.

    From the third block on, one block is unpacked while the one before it is used: unpacking and
    checksums leave Python's lock to others. Who only looks at the beginning reads no more than that.
    """

    def read(block: Block) -> Records | Loss:
        records = cache.get(block.offset)
        if records is None:
            try:
                records = read_block(source, block)
            except DamagedBlock as error:
                counts = indexed_message_counts(source, block)
                return Loss(offset=block.offset, reason=str(error), messages=counts)
            cache.put(block.offset, records)
        return records

    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="read-ahead") as ahead:
        pending: Future[Records | Loss] | None = None
        for number, block in enumerate(blocks):
            records = read(block) if pending is None else pending.result()
            is_last = number + 1 == len(blocks)
            pending = None if number == 0 or is_last else ahead.submit(read, blocks[number + 1])
            yield block, records
