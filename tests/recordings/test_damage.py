"""Damage costs what is damaged, is counted, and never changes a frame.

Recordings of 12 frames in several chunks are cut and flipped at seeded places; one bit at a time in
every byte that is not a chunk's payload is too slow for each run, so those places are sampled too.
"""

import hashlib
import struct
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zstandard

from recordings.errors import RecordingError
from recordings.mcap_files.chunks import DamagedBlock
from recordings.mcap_files.framing import MAX_BLOCK_SIZE
from recordings.mcap_files.index import Block, read_block
from recordings.mcap_files.mcap_file import McapFile
from recordings.mcap_files.sources import FileSource
from recordings.reading import McapRecording, open_recording
from recordings.types import Damage
from tests.recordings.samples import CONTAINERS, SECOND_NS, Scribe, camera_info, image, transform

K = (35.0, 36.0, 18.5, 15.25)
CHECKED = ["zstd", "lz4 without message index", "no compression", "no summary"]
"""Containers whose every message stands under a checksum."""
UNCHECKED = [name for name in CONTAINERS if name not in CHECKED]
FRAMES = 12
CUTS = FLIPS = HEAD_FLIPS = 25
CHUNK, MESSAGE, DATA_END = 6, 5, 15


def write(path: Path, container: str) -> bytes:
    """A recording of noise, its bytes."""
    rng = np.random.default_rng(3)
    with Scribe(path, **CONTAINERS[container]) as scribe:
        for i in range(FRAMES):
            stamp = SECOND_NS + i * SECOND_NS // 10
            scribe.ros2("/c/camera_info", camera_info(stamp, (40, 30), K), stamp)
            noise = rng.integers(500, 600, (30, 40)).astype(np.uint16)
            scribe.ros2("/c/depth", image(stamp, "16UC1", noise), stamp)
            scribe.ros2("/tf", transform(stamp, "map", "camera", (i, 0, 0)), stamp)
    return path.read_bytes()


def read(path: Path) -> tuple[list[tuple[int, str]], Damage, McapRecording]:
    """Stamp and hash of every frame, and what was lost."""
    recording = open_recording(path)
    frames = [(f.time_ns, hashlib.sha256(f.depth_m.tobytes()).hexdigest()) for f in recording]
    return frames, recording.damage, recording


def records(data: bytes | bytearray) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of every record of a sound file."""
    position = 8
    while position < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, position)
        yield opcode, position, position + 9 + length
        position += 9 + length


def head_bytes(data: bytes) -> np.ndarray:
    """The places of all bytes that are not the payload of a chunk or of a message."""
    places = [*range(8), *range(len(data) - 8, len(data))]
    for opcode, start, end in records(data):
        places += range(start, {CHUNK: start + 53, MESSAGE: start + 31}.get(opcode, end))
    return np.array(places)


def flipped(data: bytes, place: int, bit: int) -> bytes:
    """The bytes with one bit turned."""
    damaged = bytearray(data)
    damaged[place] ^= 1 << bit
    return bytes(damaged)


def damaged_copies(data: bytes, seed: int) -> Iterator[tuple[str, bytes]]:
    """Cuts and flips at random places, flips in heads and indexes among them."""
    rng = np.random.default_rng(seed)
    for place in rng.integers(1, len(data), CUTS):
        yield f"cut at {place}", data[:place]
    heads = rng.choice(head_bytes(data), HEAD_FLIPS)
    for place in [*rng.integers(0, len(data), FLIPS), *heads]:
        bit = int(rng.integers(8))
        yield f"bit {bit} of byte {place}", flipped(data, place, bit)


@pytest.mark.parametrize("container", CHECKED)
def test_no_frame_is_ever_wrong_and_no_loss_is_silent(container, recording_path, seed):
    """Under checksums every frame given is one of the intact ones, and a missing one shows in the damage."""
    data = write(recording_path, container)
    intact, damage, recording = read(recording_path)
    assert len(intact) == FRAMES
    assert damage == Damage()

    for name, copy in damaged_copies(data, seed):
        recording_path.write_bytes(copy)
        try:
            frames, damage, damaged = read(recording_path)
        except RecordingError:
            continue
        assert set(frames) <= set(intact), name
        assert frames == sorted(frames), name
        assert len(frames) == FRAMES or damage, name
        assert damaged.intrinsics == recording.intrinsics, name


@pytest.mark.parametrize("container", UNCHECKED)
def test_without_checksums_nothing_but_our_error_is_raised(container, recording_path, seed):
    """What cannot be checked is reported as unverified; a lost frame still shows."""
    data = write(recording_path, container)
    intact, damage, _ = read(recording_path)
    assert len(intact) == FRAMES
    assert not damage
    assert damage.verified == ("data checksum" in container)

    for name, copy in damaged_copies(data, seed):
        recording_path.write_bytes(copy)
        try:
            frames, damage, _ = read(recording_path)
        except RecordingError:
            continue
        assert len(frames) == FRAMES or damage, name
        if set(frames) - set(intact):
            assert not damage.verified, name


def test_one_flipped_bit_costs_one_chunk_and_its_messages_are_counted(recording_path):
    """The summary and the message index say exactly what a damaged chunk held."""
    data = write(recording_path, "zstd")
    intact, _, _ = read(recording_path)
    chunks = [(start, end) for opcode, start, end in records(data) if opcode == CHUNK]
    for start, end in chunks:
        recording_path.write_bytes(flipped(data, (start + end) // 2, 3))
        file = McapFile(recording_path)
        found = sum(1 for _ in file.messages())
        assert len(file.losses) == 1
        assert found + file.lost_messages == 3 * FRAMES
        frames, damage, _ = read(recording_path)
        assert damage.lost_chunks == 1
        assert len(intact) > len(frames) >= len(intact) - damage.lost_messages


def test_a_block_that_breaks_off_loses_only_what_stands_behind_the_break(recording_path, monkeypatch):
    """What a chunk gave before is not lost, nor what is read ahead meanwhile, be the disk slow."""
    data = bytearray(write(recording_path, "no compression"))
    start = [start for opcode, start, _ in records(data) if opcode == CHUNK][2]
    data[start + 33 : start + 37] = bytes(4)  # the checksum
    second = start + 49
    for _ in range(2):
        second += 9 + struct.unpack_from("<BQ", data, second)[1]
    struct.pack_into("<Q", data, second + 1, 10**6)
    recording_path.write_bytes(data)

    def slow_read(self: FileSource, offset: int, length: int) -> bytes:
        self._file.seek(offset)
        time.sleep(0.002)
        return self._file.read(max(0, min(length, self.size - offset)))

    for read_at in (FileSource.read, slow_read):
        monkeypatch.setattr(FileSource, "read", read_at)
        file = McapFile(recording_path)
        found = sum(1 for _ in file.messages())
        assert len(file.losses) == 1
        assert file.lost_messages > 0
        assert found + file.lost_messages == 3 * FRAMES


def test_a_block_larger_than_memory_is_taken_for_is_not_read():
    """Whatever a file's size allows; a source that is read fails the test."""
    sizes = {"stored_size": MAX_BLOCK_SIZE + 1, "unpacked_size": 1000}
    block = Block(offset=8, payload_offset=61, compression="zstd", start_time_ns=0, channel_ids=None, **sizes)
    with pytest.raises(DamagedBlock, match=f"claims {MAX_BLOCK_SIZE + 1} bytes"):
        read_block(None, block)  # pyright: ignore[reportArgumentType]


def test_damage_outside_of_any_payload_costs_nothing(recording_path):
    """A wrong opcode, length, size or time in a chunk's head does not lose the chunk: the summary knows."""
    data = write(recording_path, "zstd")
    intact, _, _ = read(recording_path)
    (_, start, _), *_ = [record for record in records(data) if record[0] == CHUNK]
    for place in [*range(start, start + 33), *range(start + 37, start + 53)]:  # all but the checksum itself
        bit = place % 8
        recording_path.write_bytes(flipped(data, place, bit))
        frames, damage, _ = read(recording_path)
        assert frames == intact, (place - start, bit)
        assert damage == Damage()


def test_a_damaged_summary_costs_nothing(recording_path, seed):
    """Any bit of the summary may be wrong: the data say the same."""
    data = write(recording_path, "zstd")
    intact, _, _ = read(recording_path)
    (end_of_data,) = [end for opcode, _, end in records(data) if opcode == DATA_END]
    rng = np.random.default_rng(seed)
    for place in rng.integers(end_of_data, len(data), 60):
        recording_path.write_bytes(flipped(data, place, int(rng.integers(8))))
        frames, damage, _ = read(recording_path)
        assert frames == intact
        assert not damage


def test_every_cut_of_a_recording_is_read_up_to_it(recording_path):
    """Cut anywhere, a recording gives the frames of the chunks before the cut, and one lost chunk."""
    data = write(recording_path, "zstd")
    intact, _, _ = read(recording_path)
    ends = [end for opcode, _, end in records(data) if opcode == CHUNK]
    (end_of_data,) = [end for opcode, _, end in records(data) if opcode == DATA_END]
    for cut in range(ends[2], end_of_data, 197):
        recording_path.write_bytes(data[:cut])
        frames, damage, _ = read(recording_path)
        assert frames == intact[: len(frames)]
        assert damage.lost_chunks == 1
        assert damage.verified
    for cut in range(end_of_data, len(data), 197):
        recording_path.write_bytes(data[:cut])
        frames, damage, _ = read(recording_path)
        assert (frames, damage) == (intact, Damage())


def test_reading_goes_on_past_damage_without_a_summary(recording_path):
    """In a cut file with a damaged chunk, the chunks on both sides of the damage are read."""
    data = write(recording_path, "zstd")
    intact, _, _ = read(recording_path)
    chunks = [(start, end) for opcode, start, end in records(data) if opcode == CHUNK]
    cut = chunks[-1][1]
    middle = (chunks[2][0] + chunks[2][1]) // 2
    for place in (middle, chunks[2][0] + 1, chunks[2][0] + 5, chunks[2][0]):
        recording_path.write_bytes(flipped(data, place, 4)[:cut])
        frames, damage, _ = read(recording_path)
        assert set(frames) <= set(intact)
        assert (frames[0], frames[-1]) == (intact[0], intact[-1])
        if place == chunks[2][0]:  # a chunk is known by its checksum, whatever its opcode says
            assert frames == intact
            assert damage.lost_chunks == 1
        else:
            assert len(frames) < FRAMES
            assert damage.lost_chunks == 2  # the damaged one, and what the cut took


@pytest.mark.parametrize("tail", [bytes(5000), b"\xff" * 5000, b"not a record" * 300])
def test_a_tail_of_junk_is_a_cut(tail, recording_path):
    """Zeros or other junk after a power cut end the recording like a cut."""
    data = write(recording_path, "zstd")
    chunks = [(start, end) for opcode, start, end in records(data) if opcode == CHUNK]
    recording_path.write_bytes(data[: chunks[2][1]])
    frames, _, _ = read(recording_path)
    recording_path.write_bytes(data[: chunks[2][1]] + tail)
    assert read(recording_path)[0] == frames
    assert read(recording_path)[1].lost_chunks == 1


def test_topic_names_outside_a_checksum_do_not_change_meanings(recording_path):
    """In an unchunked file, channels come from the checked summary, not from a damaged record."""
    data = write(recording_path, "no chunks")
    intact, _, recording = read(recording_path)
    for opcode, start, end in records(data):
        if opcode in {3, 4} and end < len(data) // 2:  # schema and channel records in the data
            for place in range(start + 9, end, 29):
                recording_path.write_bytes(flipped(data, place, 0))
                frames, _, damaged = read(recording_path)
                assert frames == intact
                assert damaged.depth_topic == recording.depth_topic


def test_a_wrong_data_checksum_is_told(recording_path):
    """Where only the whole file has a checksum, its failure is damage of nobody knows what."""
    data = write(recording_path, "no chunks, data checksum")
    message = next(start for opcode, start, _ in records(data) if opcode == MESSAGE)
    recording_path.write_bytes(flipped(data, message + 40, 1))
    _, damage, recording = read(recording_path)
    assert damage.lost_chunks == 1
    assert not damage.verified
    assert "nothing tells which" in " ".join(recording.problems)


def chunk(compression: str, payload: bytes, size: int, *, stored_size: int | None = None) -> bytes:
    """A chunk record with any claims."""
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 1, size, 1, len(name)) + name
    body += struct.pack("<Q", len(payload) if stored_size is None else stored_size) + payload
    return struct.pack("<BQ", CHUNK, len(body)) + body


@pytest.mark.parametrize(
    "attack",
    [
        struct.pack("<BQ", MESSAGE, 2**60) + bytes(100),
        struct.pack("<BQ", CHUNK, 2**63) + bytes(100),
        chunk("", b"x" * 50, 2**62),
        chunk("zstd", b"x" * 50, 2**62),
        chunk("zstd", bytes.fromhex("28b52ffde0ffffffffffffff3f") + bytes(50), 1000),
        chunk("zstd", zstandard.compress(bytes(1 << 26)), 1000),
        chunk("zstd", zstandard.compress(bytes(1 << 26)), 2**40),
        chunk("lz4", bytes(50), 2**62),
        chunk("zstd", b"x" * 50, 1000, stored_size=2**60),
        chunk("a name" * 1000, b"x" * 50, 1000),
    ],
)
def test_claimed_sizes_take_no_memory(attack, recording_path):
    """A record that claims more than there is, or a bomb, is left out; the rest of the file is read."""
    data = write(recording_path, "zstd")
    (_, start, _), *_ = [record for record in records(data) if record[0] == CHUNK]
    (end_of_data,) = [begin for opcode, begin, _ in records(data) if opcode == DATA_END]
    intact, _, _ = read(recording_path)
    recording_path.write_bytes(data[:start] + attack + data[start:end_of_data])
    tracemalloc.start()
    frames, damage, _ = read(recording_path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert frames == intact
    assert damage.lost_chunks == 2  # the attack, and the end that was cut off
    assert peak < 32 << 20


def test_a_damaged_magic_is_forgiven(recording_path):
    """A bit of the first eight bytes does not make it another file."""
    data = write(recording_path, "zstd")
    intact, _, _ = read(recording_path)
    for place in range(8):
        recording_path.write_bytes(flipped(data, place, 2))
        assert read(recording_path)[:2] == (intact, Damage())
