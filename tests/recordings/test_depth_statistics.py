"""What depths and stamps look like, and that what cannot be right is told with what to do."""

import numpy as np
import pytest

from recordings.options import ReadOptions
from recordings.reading import open_recording
from tests.recordings.samples import SECOND_NS, Scribe, camera_info, image

SIZE = (80, 60)
AS_RECORDED = ReadOptions()


def room_mm(rng: np.random.Generator) -> np.ndarray:
    """Slanted depths of 1 to 3 m with a sensor's noise, a tenth without a return."""
    smooth = np.linspace(1000, 3000, SIZE[0])[None] + np.linspace(0, 200, SIZE[1])[:, None]
    depth = np.rint(smooth + rng.normal(0, 3, smooth.shape))
    return (depth * (rng.random(depth.shape) > 0.1)).astype(np.uint16)


def recorded(
    path, images, stamps_s=None, encoding="16UC1", options=AS_RECORDED, *, logged_by_stamp=False, **fields
):
    """A recording of these images, a tenth of a second apart unless stamped otherwise; opened."""
    stamps_s = np.arange(1, len(images) + 1) / 10 + 1 if stamps_s is None else stamps_s
    with Scribe(path) as scribe:
        first = round(stamps_s[0] * SECOND_NS) if logged_by_stamp else 1
        scribe.ros2("/camera/depth/camera_info", camera_info(1, SIZE, (70.0, 72.0, 39.0, 30.0)), first)
        for number, (pixels, seconds) in enumerate(zip(images, stamps_s, strict=True)):
            stamp = round(seconds * SECOND_NS)
            log_time = stamp if logged_by_stamp else number + 1
            scribe.ros2("/camera/depth/image_rect_raw", image(stamp, encoding, pixels, **fields), log_time)
    return open_recording(path, options)


@pytest.fixture
def images(seed):
    """Twelve frames of a room."""
    rng = np.random.default_rng(seed)
    return [room_mm(rng) for _ in range(12)]


def test_a_room_in_its_right_unit_gives_no_warning(recording_path, images):
    """And its quantiles are those of the pixels of the frames that were looked at."""
    recording = recorded(recording_path, images)
    found = recording.statistics()
    every = np.concatenate([one[one > 0] for one in images]) / 1000

    assert found.warnings(recording.size, recording.intrinsics) == []
    assert found.frames == 12
    assert found.depth_m is not None
    np.testing.assert_allclose(found.depth_m, np.quantile(every, [0.01, 0.5, 0.99]), rtol=0.02)
    assert found.measured_share == pytest.approx(0.9, abs=0.02)


def test_millimetres_of_floats_that_are_given_as_such_give_no_warning(recording_path, images):
    """The scale that the warning asks for ends it."""
    floats = [one.astype(np.float32) for one in images]
    recording = recorded(recording_path, floats, None, "32FC1", ReadOptions(depth_scale_m=0.001))
    assert recording.statistics().warnings(recording.size, recording.intrinsics) == []


@pytest.mark.parametrize(
    ("change", "encoding", "options", "told"),
    [
        (lambda mm: 10 * mm, "16UC1", ReadOptions(), "0.0001 for 0.1 mm"),
        (lambda mm: mm.astype(np.float32), "32FC1", ReadOptions(), "if the numbers are millimetres"),
        (lambda mm: mm.byteswap(), "16UC1", ReadOptions(), "bytes of each number were swapped"),
        (lambda mm: 0 * mm, "16UC1", ReadOptions(), "only 0.0% of the pixels"),
        (lambda mm: mm, "16UC1", ReadOptions(depth_scale_m=0.01), "the depths are unusual: 10"),
        (lambda mm: mm, "16UC1", ReadOptions(depth_scale_m=1e-5), "median 0.02"),
    ],
    ids=["0.1 mm", "mm as floats", "byte order", "nothing", "scale", "small"],
)
def test_depths_that_can_hardly_be_are_told(recording_path, images, change, encoding, options, told):
    """With what to do about it."""
    recording = recorded(recording_path, [change(one) for one in images], None, encoding, options)
    warnings = [
        one
        for one in recording.statistics().warnings(recording.size, recording.intrinsics)
        if "repeat" not in one and "but zeros" not in one
    ]

    assert len(warnings) == 1
    assert told in warnings[0]


def test_frames_that_repeat_are_counted(recording_path, images):
    """As of a driver that stalls."""
    repeated = [one for one in images[:4] for _ in range(3)]
    recording = recorded(recording_path, repeated)
    found = recording.statistics()

    assert found.identical_frames == 8
    assert "8 of 12 depth frames repeat" in found.warnings(recording.size, recording.intrinsics)[0]


def test_frames_without_depth_are_counted(recording_path, images):
    """They do not repeat each other as those of a driver that stalls."""
    recording = recorded(recording_path, [*images[:6], *(0 * one for one in images[:4]), *images[6:8]])
    found = recording.statistics()

    assert (found.blank_frames, found.identical_frames) == (4, 0)
    assert found.warnings(recording.size, recording.intrinsics) == [
        "4 of 12 depth frames hold no depth at all, but zeros"
    ]


@pytest.mark.parametrize("logged_by_stamp", [False, True])
def test_a_clock_that_steps_back_is_told(recording_path, images, logged_by_stamp):
    """With how often, and when first; also where it is the recorder's own, by which messages are sorted."""
    stamps = np.concatenate([np.arange(6), np.arange(6) - 7]) / 10 + 5
    recording = recorded(recording_path, images, stamps, logged_by_stamp=logged_by_stamp)
    found = recording.statistics()

    assert found.stamp_steps_back == 1
    assert found.first_step_back_s == pytest.approx(0.5)
    told = found.warnings(recording.size, recording.intrinsics)[0]
    assert "step back once" in told
    assert "first at 0.500 s: a clock was set" in told


def test_frames_that_are_written_late_are_no_alarm(recording_path, images):
    """They are put in order; the warning says so, with how late they are."""
    stamps = np.array([0, 1, 2, 5, 3, 4, 6, 7, 9, 8, 10, 11]) / 10 + 5
    recording = recorded(recording_path, images, stamps)
    told = recording.statistics().warnings(recording.size, recording.intrinsics)[0]

    assert "step back 2 times by up to 0.2 s, first at 0.500 s: read in the order" in told
    assert [frame.time_ns for frame in recording] == sorted(round(one * SECOND_NS) for one in stamps)
    assert recording.problems == []


def test_a_clock_that_stands_still_is_named(recording_path, images):
    """And not called damage of the file."""
    recording = recorded(recording_path, images, np.full(12, 3.0))

    assert len(list(recording)) == 1
    assert any("the clock stood still" in problem for problem in recording.problems)
