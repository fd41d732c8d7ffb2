"""Recordings of several files, compressed files, and the order of time."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import zstandard

from recordings.errors import RecordingError
from recordings.mcap_files.bag import Bag
from recordings.options import ReadOptions
from recordings.reading import open_recording
from recordings.stamps import in_order_of_stamps
from tests.recordings.samples import SECOND_NS, Scribe, camera_info, image

K = (35.0, 36.0, 18.5, 15.25)
DEPTH = np.full((30, 40), 1000, np.uint16)


def write_part(path: Path, numbers, *, stamps=None) -> None:
    """Frames with these numbers, 0.1 s apart; `stamps` replaces their header stamps."""
    with Scribe(path) as scribe:
        for number in numbers:
            log_time = SECOND_NS * (10 + number) // 10
            stamp = log_time if stamps is None else stamps[number]
            scribe.ros2("/camera_info", camera_info(stamp, (40, 30), K), log_time)
            scribe.ros2("/depth", image(stamp, "16UC1", DEPTH + number), log_time)


def metadata(files: dict[str, int]) -> str:
    """A rosbag2 metadata.yaml with the message count of each file."""
    lines = ["rosbag2_bagfile_information:", "  version: 5", "  storage_identifier: mcap"]
    lines += ["  relative_file_paths:", *(f"    - {name}" for name in files), "  files:"]
    for name, count in files.items():
        lines += [f"    - path: {name}", f"      message_count: {count}"]
    return "\n".join(lines)


def numbers_of(path: Path) -> list[int]:
    """The numbers of the frames that a recording gives."""
    return [round(float(frame.depth_m[0, 0]) * 1000) - 1000 for frame in open_recording(path)]


def test_a_split_bag_is_one_recording(tmp_path):
    """The files are read in the order of metadata.yaml, also with the folder's name before them."""
    write_part(tmp_path / "zz.mcap", range(3))
    write_part(tmp_path / "aa.mcap", range(3, 6))
    name = tmp_path.name
    (tmp_path / "metadata.yaml").write_text(metadata({f"{name}/zz.mcap": 6, f"{name}/aa.mcap": 6}))
    assert numbers_of(tmp_path) == list(range(6))
    assert len(open_recording(tmp_path)) == 6


@pytest.mark.parametrize("text", [None, "", "{{{", "- 1", "rosbag2_bagfile_information: 3"])
def test_a_split_bag_without_metadata_is_ordered_by_number(text, tmp_path):
    """Without readable metadata the numbers in the names decide, 10 after 9."""
    for number in (0, 9, 10):
        write_part(tmp_path / f"bag_{number}.mcap", range(number * 2, number * 2 + 2))
    if text is not None:
        (tmp_path / "metadata.yaml").write_text(text)
    assert numbers_of(tmp_path) == [0, 1, 18, 19, 20, 21]


def test_a_missing_part_is_counted(tmp_path):
    """A file that metadata.yaml lists and that is not there is a loss of its messages."""
    write_part(tmp_path / "a_0.mcap", range(2))
    (tmp_path / "metadata.yaml").write_text(metadata({"a_0.mcap": 4, "a_1.mcap": 6}))
    recording = open_recording(tmp_path)
    assert len(recording) == 2
    assert (recording.damage.lost_messages, recording.damage.lost_chunks) == (6, 1)


def test_folders_that_are_no_recording(tmp_path):
    """An empty folder, several recordings, SQLite storage and missing files are told apart."""
    with pytest.raises(RecordingError, match="holds no MCAP file"):
        Bag(tmp_path)
    write_part(tmp_path / "kitchen.mcap", [0])
    write_part(tmp_path / "office.mcap", [0])
    with pytest.raises(RecordingError, match=r"several recordings \(kitchen\.mcap, office\.mcap"):
        Bag(tmp_path)
    text = metadata({"x_0.mcap": 1})
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(RecordingError, match="none of the files"):
        Bag(tmp_path)
    (tmp_path / "metadata.yaml").write_text(text.replace("mcap", "sqlite3", 1))
    with pytest.raises(RecordingError, match="voxscene import bag"):
        Bag(tmp_path)


@pytest.mark.parametrize(("share", "suffix"), [(1.0, "zstd"), (0.6, "zstd"), (1.0, "zst")])
def test_a_zstd_file_is_read_as_it_is(share, suffix, seed, tmp_path):
    """`.mcap.zstd` is unpacked on the way, and recovered up to where it is cut."""
    plain, packed = tmp_path / "r.mcap", tmp_path / f"r.mcap.{suffix}"
    rng = np.random.default_rng(seed)
    with Scribe(plain) as scribe:
        for number in range(300):  # zstd flushes blocks of 128 KiB
            stamp = SECOND_NS + number
            scribe.ros2("/camera_info", camera_info(stamp, (40, 30), K), stamp)
            noise = rng.integers(500, 4000, (30, 40)).astype(np.uint16)
            scribe.ros2("/depth", image(stamp, "16UC1", noise), stamp)
    data = zstandard.compress(plain.read_bytes())
    packed.write_bytes(data[: int(len(data) * share)])
    expected = [frame.depth_m.tobytes() for frame in open_recording(plain)]
    recording = open_recording(packed)
    found = [frame.depth_m.tobytes() for frame in recording]

    assert found == expected[: len(found)]
    assert recording.damage.verified
    if share == 1.0:
        assert len(found) == 300
        assert not recording.damage
    else:
        assert 100 < len(found) < 300
        assert recording.damage.lost_chunks == 1


def test_header_stamps_are_the_time(tmp_path):
    """Frames are ordered and named by their stamps, whatever their log times are."""
    path = tmp_path / "r.mcap"
    stamps = {0: 70, 1: 30, 2: 50, 3: 40, 4: 90}
    write_part(path, range(5), stamps=stamps)
    recording = open_recording(path)
    assert [frame.time_ns for frame in recording] == [30, 40, 50, 70, 90]
    assert numbers_of(path) == [1, 3, 2, 0, 4]
    assert not recording.damage


def test_without_stamps_the_log_time_serves(tmp_path):
    """A driver that sets no stamps gives the times of logging."""
    path = tmp_path / "r.mcap"
    write_part(path, range(3), stamps=dict.fromkeys(range(3), 0))
    assert [frame.time_ns for frame in open_recording(path)] == [SECOND_NS * (10 + i) // 10 for i in range(3)]


@pytest.mark.parametrize(("clock_ns", "times"), [(0, [0, 1, 2, 3]), (17 * 10**17, [1, 2, 3])])
def test_a_stamp_of_zero_is_a_time_of_simulations_alone(clock_ns, times, tmp_path):
    """A simulation begins at 0; among stamps of today a frame without one is lost, and this is said."""
    path = tmp_path / "r.mcap"
    write_part(path, range(4), stamps={i: clock_ns + i if i else 0 for i in range(4)})
    recording = open_recording(path)

    assert [frame.time_ns for frame in recording] == [clock_ns + time for time in times]
    assert recording.damage.lost_messages == 4 - len(times)
    assert all("has no stamp" in problem for problem in recording.problems)


def test_repeated_and_late_stamps_are_left_out_and_counted(tmp_path):
    """Time only goes forward; what would break that is a counted loss."""
    path = tmp_path / "r.mcap"
    stamps = {i: 1000 + i for i in range(20)} | {5: 1004, 19: 1}
    write_part(path, range(20), stamps=stamps)
    recording = open_recording(path)
    times = [frame.time_ns for frame in recording]
    assert times == sorted(set(times))
    assert len(times) == 18
    assert recording.damage.lost_messages == 2


def test_a_frame_that_is_written_twice_is_read_once(tmp_path, seed):
    """As where two recorders' files were merged: nothing is lost. Another image of the same stamp is."""
    path = tmp_path / "r.mcap"
    images = np.random.default_rng(seed).integers(500, 4000, (3, 6, 8)).astype(np.uint16)
    with Scribe(path) as scribe:
        for number, stamp in enumerate([1, 2, 2]):
            for log_time in (10 * number, 10 * number + 1):
                scribe.ros2("/depth", image(stamp, "16UC1", images[number]), log_time)
    recording = open_recording(path, ReadOptions(intrinsics=(9.0, 9.0, 3.5, 2.5)))

    assert [frame.time_ns for frame in recording] == [1, 2]
    assert recording.damage.lost_messages == 1


def test_order_within_the_window_is_restored(seed):
    """Items up to a few places late come out sorted, each once."""
    rng = np.random.default_rng(seed)
    late = np.argsort(np.arange(200) + rng.uniform(0, 6, 200))
    left_out: list[int] = []
    found = [stamp for stamp, _ in in_order_of_stamps(((int(i), None) for i in late), left_out.append)]
    assert found == list(range(200))
    assert not left_out


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, range(10)),
        ({"every": 3}, [0, 3, 6, 9]),
        ({"start_s": 0.25}, range(3, 10)),
        ({"end_s": 0.3}, range(4)),
        ({"start_s": 0.2, "end_s": 0.7, "every": 2}, [2, 4, 6]),
        ({"start_s": 99.0}, []),
    ],
)
def test_options_choose_frames(options, expected, tmp_path):
    """Times count from the first frame; every n-th counts from the first that is in the window."""
    path = tmp_path / "r.mcap"
    write_part(path, range(10))
    recording = open_recording(path, ReadOptions(**options))
    stamps = [SECOND_NS * (10 + i) // 10 for i in expected]
    assert [frame.time_ns for frame in recording] == stamps
    assert list(recording.stamps_ns()) == stamps
    assert len(recording) == len(stamps)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"every": 0}, "every must be at least 1"),
        ({"start_s": 2.0, "end_s": 1.0}, "start <= end"),
        ({"start_s": -1.0}, "start <= end"),
        ({"start_s": float("nan")}, "start_s must be a finite number"),
        ({"min_depth_m": 2.0, "max_depth_m": 1.0}, "min < max"),
        ({"depth_scale_m": 5000.0}, "1/5000 = 0.0002"),
        ({"depth_scale_m": 0.0}, "depth scale"),
        ({"intrinsics": (0.0, 1.0, 1.0, 1.0)}, "fx, fy > 0"),
        ({"intrinsics": (1.0, 1.0, 1e9, 1.0)}, "pixels"),
        ({"intrinsics": (1.0, 1.0, 1.0)}, "intrinsics are four numbers, fx, fy, cx, cy"),
    ],
)
def test_impossible_options_say_so(options, complaint):
    """Each impossible value is named."""
    with pytest.raises(ValueError, match=complaint):
        ReadOptions(**options)


def test_real_bags_are_read(shared_data):
    """Every recorded bag of rosbag2's own tests gives the messages that its metadata count."""
    folders = sorted({path.parent for path in (shared_data / "bags_real").rglob("*.mcap")})
    assert len(folders) > 5
    for folder in folders:
        for path in folder.glob("*.mcap"):
            bag = Bag(path)
            assert sum(1 for _ in bag.messages()) > 0
            assert not bag.damage, path
    wbag = shared_data / "bags_real/ros2_rosbag2/rosbag2_py/test/resources/mcap/wbag"
    assert sum(1 for _ in Bag(wbag).messages()) == 6074


def test_a_missing_recording_is_one_clear_line(tmp_path):
    """Missing, empty and foreign files are told apart."""
    path = tmp_path / "r.mcap"
    with pytest.raises(RecordingError, match=r"cannot read .*No such file"):
        Bag(path)
    path.touch()
    with pytest.raises(RecordingError, match="is empty"):
        Bag(path)
    path.write_bytes(b"RIFF and other things")
    with pytest.raises(RecordingError, match="not an MCAP file"):
        Bag(path)
    shutil.copy(__file__, path)
    with pytest.raises(RecordingError, match="not an MCAP file"):
        Bag(path)


@pytest.mark.parametrize(
    ("start", "advice"),
    [
        (b"#ROSBAG V2.0\n", r"ROS 1 bag; convert it with: voxscene import bag .*r.mcap OUT.mcap"),
        (b"SQLite format 3\0", "voxscene import bag"),
        (b"\x1f\x8b\x08\0\0\0\0\0", "unpack it first"),
        (b"PK\x03\x04\0\0\0\0", "unpack it first"),
    ],
)
def test_what_another_file_is_and_what_to_do_with_it_is_told(start, advice, tmp_path):
    """Bags of ROS 1 and of SQLite have an importer; archives want to be unpacked."""
    path = tmp_path / "r.mcap"
    path.write_bytes(start)
    with pytest.raises(RecordingError, match=advice):
        Bag(path)
