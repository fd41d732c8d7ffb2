"""Written recordings are whole, checked, and read by other programs."""

import zlib
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk, ChunkIndex, DataEnd, Footer, Message, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from recordings.errors import RecordingError
from recordings.reading import open_recording
from recordings.types import CameraIntrinsics, Frame
from recordings.writer import DEPTH_TOPIC, MessageSchema, RecordingWriter

DATA_END_SIZE = 9 + 4


def write(path: Path, camera: CameraIntrinsics, frames: list[Frame], poses, *, unit_m=0.001) -> None:
    """A recording of frames with poses and metadata."""
    with RecordingWriter(path, camera, depth_unit_m=unit_m, profile="ros2") as writer:
        for frame, pose in zip(frames, poses, strict=True):
            writer.write_depth(frame)
            writer.write_camera_pose(frame.time_ns, pose)
        writer.write_metadata("made by", {"test": "writer"})


@pytest.mark.parametrize("unit_m", [0.001, 0.0002, None])
def test_frames_come_back_bit_for_bit(recording_path, camera, frames, poses, unit_m):
    """What is written is read again: stamps, depths, holes and camera."""
    write(recording_path, camera, frames, poses, unit_m=unit_m)
    recording = open_recording(recording_path)

    assert recording.intrinsics == camera
    assert len(recording) == len(frames)
    for _ in range(2):  # iterating may be repeated
        for expected, actual in zip(frames, recording, strict=True):
            assert actual.time_ns == expected.time_ns
            np.testing.assert_array_equal(actual.depth_m, expected.depth_m)
    assert not recording.damage
    assert recording.damage.verified


def test_other_readers_agree(recording_path, camera, frames, poses):
    """Two other readers, mcap with mcap_ros2 and rosbags, find the same pixels; every checksum holds."""
    write(recording_path, camera, frames, poses)
    expected = [np.rint(frame.depth_m * 1000).astype(np.uint16) for frame in frames]

    with recording_path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        images = [message for *_, message in reader.iter_decoded_messages([DEPTH_TOPIC])]
    with AnyReader([recording_path]) as bag:
        depth = [c for c in bag.connections if c.topic == DEPTH_TOPIC]
        others: list[Any] = [bag.deserialize(raw, c.msgtype) for c, _, raw in bag.messages(depth)]
    with recording_path.open("rb") as file:
        assert list(StreamReader(file, validate_crcs=True).records)
    for pixels, image, other in zip(expected, images, others, strict=True):
        assert image.encoding == other.encoding == "16UC1"
        np.testing.assert_array_equal(np.frombuffer(image.data, "<u2").reshape(pixels.shape), pixels)
        np.testing.assert_array_equal(other.data.view("<u2").reshape(pixels.shape), pixels)


def test_indexes_lead_to_what_they_name(recording_path, camera, frames, poses):
    """What `mcap doctor` looks at: offsets, times, counts and checksums of the file's indexes."""
    write(recording_path, camera, frames, poses)
    data = recording_path.read_bytes()
    with recording_path.open("rb") as file:
        records = list(StreamReader(file, emit_chunks=True, validate_crcs=True).records)
    chunks = [record for record in records if isinstance(record, Chunk)]
    indexes = [record for record in records if isinstance(record, ChunkIndex)]
    (statistics,) = [record for record in records if isinstance(record, Statistics)]
    (data_end,) = [record for record in records if isinstance(record, DataEnd)]
    (footer,) = [record for record in records if isinstance(record, Footer)]

    end_of_data = footer.summary_start - DATA_END_SIZE
    assert data_end.data_section_crc == zlib.crc32(data[:end_of_data]) != 0
    assert footer.summary_crc == zlib.crc32(data[footer.summary_start : -12]) != 0
    assert statistics.chunk_count == len(chunks) == len(indexes) > 0
    counts: Counter[int] = Counter()
    for chunk, index in zip(chunks, indexes, strict=True):
        assert chunk.uncompressed_crc != 0
        assert data[index.chunk_start_offset] == Opcode.CHUNK
        messages = [record for record in breakup_chunk(chunk) if isinstance(record, Message)]
        times = [message.log_time for message in messages]
        assert (min(times), max(times)) == (index.message_start_time, index.message_end_time)
        of_chunk = Counter(message.channel_id for message in messages)
        assert set(index.message_index_offsets) == set(of_chunk)
        assert all(data[offset] == Opcode.MESSAGE_INDEX for offset in index.message_index_offsets.values())
        counts += of_chunk
    assert counts == statistics.channel_message_counts
    assert counts.total() == statistics.message_count == 3 * len(frames)


@pytest.mark.parametrize("start", [b"#ROSBAG V2.0\n", b"SQLite format 3\x00", b"notes", b"\x89MCAP0"])
def test_files_of_other_programs_are_not_replaced(start, recording_path, camera, frames, poses):
    """Bags, notes, damaged recordings; an empty file is, and so is a recording that was written here."""
    recording_path.write_bytes(start)
    with pytest.raises(RecordingError, match="by another program"):
        RecordingWriter(recording_path, camera)
    assert recording_path.read_bytes() == start
    recording_path.write_bytes(b"")
    for _ in range(2):
        write(recording_path, camera, frames, poses)
    assert len(open_recording(recording_path)) == len(frames)


def test_an_interrupted_recording_leaves_nothing(recording_path, camera, frames, poses):
    """An exception inside the block removes the partial file and keeps an older recording."""
    write(recording_path, camera, frames, poses)
    older = recording_path.read_bytes()

    def interrupt() -> None:
        with RecordingWriter(recording_path, camera) as writer:
            writer.write_depth(frames[0])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupt()

    assert recording_path.read_bytes() == older
    assert list(recording_path.parent.iterdir()) == [recording_path]


def test_a_missing_folder_is_one_clear_line(tmp_path, camera):
    """The error names the file and the reason."""
    path = tmp_path / "nowhere" / "out.mcap"
    with pytest.raises(RecordingError, match=r"cannot write .*out\.mcap: No such file or directory"):
        RecordingWriter(path, camera)


def test_a_full_disk_leaves_nothing(recording_path, camera, frames, limited_files):
    """Running out of space is a RecordingError, and the partial file is gone."""
    with limited_files(2000), pytest.raises(RecordingError, match=r"cannot write .*File too large"):
        write(recording_path, camera, frames, np.tile(np.eye(4), (len(frames), 1, 1)))
    assert list(recording_path.parent.iterdir()) == []


def test_of_two_writers_to_one_name_the_second_is_refused(recording_path, camera, frames):
    """The first goes on and leaves a whole file; what a killed one left is written over."""
    recording_path.with_name(recording_path.name + ".partial").write_bytes(b"left by a kill")
    with RecordingWriter(recording_path, camera) as first:
        first.write_depth(frames[0])
        with pytest.raises(RecordingError, match="being written by another process"):
            RecordingWriter(recording_path, camera)
        for frame in frames[1:]:
            first.write_depth(frame)

    assert len(list(open_recording(recording_path))) == len(frames)
    assert list(recording_path.parent.iterdir()) == [recording_path]


def test_generic_messages_keep_their_schema(recording_path):
    """Any schema can be written; sequence numbers count the messages of a topic."""
    schema = MessageSchema(name="Note", encoding="jsonschema", data=b"{}", message_encoding="json")
    with RecordingWriter(recording_path) as writer:
        writer.write("/a", schema, b'{"x": 1}', 10)
        writer.write("/b", schema, b'{"x": 2}', 20)
        writer.write("/a", schema, b'{"x": 3}', 30)

    with recording_path.open("rb") as file:
        found = list(make_reader(file).iter_messages())
    assert [(c.topic, s and s.name, m.data, m.sequence, m.log_time) for s, c, m in found] == [
        ("/a", "Note", b'{"x": 1}', 0, 10),
        ("/b", "Note", b'{"x": 2}', 0, 20),
        ("/a", "Note", b'{"x": 3}', 1, 30),
    ]


def test_too_far_for_sixteen_bits_is_no_return(recording_path, camera):
    """Depths that 16-bit millimetres cannot hold do not wrap round."""
    depth_m = np.full((camera.height, camera.width), 70.0, np.float32)
    with RecordingWriter(recording_path, camera, depth_unit_m=0.001) as writer:
        writer.write_depth(Frame(time_ns=1, depth_m=depth_m))
    (frame,) = open_recording(recording_path)
    assert not frame.depth_m.any()
