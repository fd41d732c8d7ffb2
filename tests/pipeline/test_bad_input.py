"""What cannot be used ends in one clear line and the promised exit code, and leaves nothing behind."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner, Result
from PIL import Image

from pipeline.cli import voxscene
from pipeline.options import RecordingSource
from pipeline.session import open_session
from recordings.options import ReadOptions
from recordings.reading import open_recording
from slam.config import SlamConfig
from slam.result import SlamResult
from tests.pipeline.test_session import Tracker, common
from tests.recordings.samples import SECOND_NS, Scribe, camera_info, image, transform

K = (35.0, 36.0, 18.5, 15.25)
MILLIMETRES = np.random.default_rng(11).integers(500, 4000, (30, 40)).astype(np.uint16)
RGB = np.random.default_rng(12).integers(0, 255, (30, 40, 3)).astype(np.uint8)

Write = Callable[[Scribe, int], None]


def depth(
    topic: str = "/c/depth", pixels: np.ndarray = MILLIMETRES, encoding: str = "16UC1", **fields
) -> Write:
    """Writes one depth image."""
    return lambda scribe, stamp: scribe.ros2(topic, image(stamp, encoding, pixels, **fields), stamp)


def both(*writes: Write) -> Write:
    """Writes several messages."""

    def write(scribe: Scribe, stamp: int) -> None:
        for one in writes:
            one(scribe, stamp)

    return write


def pose(scribe: Scribe, stamp: int) -> None:
    """Writes where the camera was."""
    scribe.ros2("/tf", transform(stamp, "map", "camera"), stamp)


def colour(scribe: Scribe, stamp: int) -> None:
    """Writes a colour image."""
    scribe.ros2("/c/colour", image(stamp, "rgb8", RGB), stamp)


def unknown(scribe: Scribe, stamp: int) -> None:
    """Writes a message of a type that nobody knows."""
    scribe.raw("/x", ("acme/msg/Depth", "ros2msg", b"uint8 a"), "cdr", b"\0\1\0\0\5", stamp)


NO_RECORDING = {
    "missing": (None, "No such file"),
    "empty": (b"", "is empty"),
    "text": (b"hello there, no recording", "not an MCAP file"),
    "first byte": (b"\x89", "not an MCAP file"),
}
"""Content of a file, and what is said of it by any command."""
RECORDINGS: dict[str, tuple[Write, int, str]] = {
    "no depth": (pose, 0, "has no depth; its topics: /c/camera_info, /tf"),
    "colour only": (colour, 0, "has no depth; its topics: /c/camera_info, /c/colour"),
    "unknown schema": (unknown, 0, "has no depth; its topics: /c/camera_info, /x"),
    "two depth topics": (both(depth(), depth("/e/depth")), 0, "2 depth topics: /c/depth, /e/depth; choose"),
    "size over the data": (depth(height=300), 1, "no message can be used"),
    "another camera's size": (
        depth(pixels=np.full((64, 40), 900, np.uint16)),
        0,
        "its camera is for images of 40x30",
    ),
    "all zeros": (depth(pixels=MILLIMETRES * 0), 0, "no depth frame has a return"),
    "one pixel": (depth(pixels=np.full((1, 1), 900, np.uint16)), 0, "images of 1x1 pixels show no shape"),
    "all NaN": (
        depth(pixels=np.full((30, 40), np.nan, "f4"), encoding="32FC1"),
        0,
        "no depth frame has a return",
    ),
}
"""How a recording is written, the exit code of info, and what slam says."""


def run(*arguments: object) -> Result:
    """The command line, in this process."""
    return CliRunner().invoke(voxscene, [str(argument) for argument in arguments])


def assert_one_line(result: Result, line: str) -> None:
    """Exit code 1, and one line on stderr that holds `line`."""
    assert result.exit_code == 1, result.output
    assert isinstance(result.exception, SystemExit)
    assert result.stdout == ""
    assert result.stderr.startswith("voxscene: ")
    assert line in result.stderr
    assert result.stderr.splitlines()[-1].startswith("voxscene: ")


def write(path: Path, message: Write, frames: int = 3) -> Path:
    """A recording with a camera, 0.1 s between its messages."""
    with Scribe(path) as scribe:
        for stamp in range(SECOND_NS, SECOND_NS + frames * SECOND_NS // 10, SECOND_NS // 10):
            scribe.ros2("/c/camera_info", camera_info(stamp, (40, 30), K), stamp)
            message(scribe, stamp)
    return path


@pytest.mark.parametrize("command", ["info", "slam"])
@pytest.mark.parametrize("kind", NO_RECORDING)
def test_what_is_no_recording_is_said_to_be_none(kind: str, command: str, tmp_path: Path) -> None:
    """By every command, before it makes anything."""
    content, line = NO_RECORDING[kind]
    path = tmp_path / "r.mcap"
    if content is not None:
        path.write_bytes(content)
    output = ["-o", tmp_path / "run"] if command == "slam" else []
    assert_one_line(run(command, path, *output), line)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("command", ["info", "slam"])
def test_a_pipe_is_not_waited_for(command: str, tmp_path: Path) -> None:
    """A recording is read back and forth; a pipe that nobody writes to would never open."""
    path = tmp_path / "r.mcap"
    os.mkfifo(path)
    output = ["-o", tmp_path / "run"] if command == "slam" else []
    assert_one_line(run(command, path, *output), "it is a pipe or a device; copy it")


@pytest.mark.parametrize("command", ["info", "slam"])
def test_a_run_is_not_taken_for_a_recording(command: str, mug_file: Path, tmp_path: Path) -> None:
    """Its run.mcap holds depth, too, of a few frames."""
    (tmp_path / "mug.run" / "stages").mkdir(parents=True)
    shutil.copy(mug_file, tmp_path / "mug.run" / "run.mcap")
    output = ["-o", tmp_path / "run"] if command == "slam" else []
    assert_one_line(run(command, tmp_path / "mug.run", *output), "is a run, not a recording")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("command", ["info", "review", "report"])
def test_what_may_not_be_read_is_no_misuse(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ends as what cannot be read: with where, in one line, and exit code 1."""
    path = tmp_path / "secret"
    path.write_bytes(b"")
    monkeypatch.setattr(os, "access", lambda *_, **__: False)
    done = CliRunner().invoke(voxscene, [command, str(path), "--quiet"])

    assert done.exit_code == 1
    assert len(done.stderr.splitlines()) == 1
    assert str(path) in done.stderr


def test_worlds_hold_no_more_than_there_are_meshes(tmp_path: Path) -> None:
    """The number that was named and those that there are; no file is left."""
    told = run("synth", "worlds", tmp_path / "w.mcap", "--objects", 50, "--quiet")
    assert_one_line(told, "name 50 shapes; there are 8 meshes")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", RECORDINGS)
def test_recordings_without_usable_depth(kind: str, tmp_path: Path) -> None:
    """Info says what is there; slam says what is missing, and leaves no run folder."""
    message, info_code, line = RECORDINGS[kind]
    path = write(tmp_path / "r.mcap", message)
    told = run("info", path)
    assert told.exit_code == info_code, told.output
    assert_one_line(run("slam", path, "-o", tmp_path / "run", "--quiet"), line)
    assert [file.name for file in tmp_path.iterdir()] == ["r.mcap"]


def test_one_frame_is_a_recording(tmp_path: Path) -> None:
    """Its camera is where the run's frame of reference is."""
    path = write(tmp_path / "r.mcap", depth(pixels=np.full((30, 40), 900, np.uint16)), frames=1)
    result = run("slam", path, "-o", tmp_path / "run", "--quiet")
    assert result.exit_code == 0, result.output
    (line,) = (tmp_path / "run" / "trajectory.tum").read_text().splitlines()
    np.testing.assert_allclose(np.array(line.split(), float), [1, 0, 0, 0, 0, 0, 0, 1], atol=1e-9)


@pytest.mark.parametrize("command", ["slam", "parse"])
def test_times_between_which_no_frame_lies_are_named(command: str, tmp_path: Path) -> None:
    """Not a recording without depth."""
    path = write(tmp_path / "r.mcap", depth())
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "meshes" / "box.ply")
    shapes = ["--shapes", tmp_path / "meshes"] if command == "parse" else []

    told = run(command, path, *shapes, "-o", tmp_path / "run", "--start", 99, "--quiet")
    assert_one_line(told, "no frame lies between --start and --end")
    assert not (tmp_path / "run" / "sensor.toml").exists()


def test_a_picture_is_a_png(tmp_path: Path) -> None:
    """Another ending would lie about what is in the file."""
    told = run("review", tmp_path, "--screenshot", tmp_path / "a.jpg")
    assert (told.exit_code, "ends in .png" in told.stderr) == (2, True)


@pytest.mark.parametrize(
    ("bench", "option"),
    [
        ("air", "--csv"),
        ("occlusion", "--csv"),
        ("poses", "--bop"),
        ("poses", "--csv"),
        ("poses", "--curves"),
        ("shapes --meshes .", "--csv"),
        ("slam", "--csv"),
    ],
)
def test_a_bench_looks_at_its_outputs_before_any_work(bench: str, option: str, tmp_path: Path) -> None:
    """Hours of measurement are not lost to a folder that is not there."""
    told = run("bench", *bench.split(), option, tmp_path / "no" / "table.png")
    assert_one_line(told, f"there is no folder {tmp_path / 'no'}")


def test_curves_are_pictures(tmp_path: Path) -> None:
    """Another ending is told before any image is judged."""
    told = run("bench", "poses", "--curves", tmp_path / "curves.pdf")
    assert (told.exit_code, "ends in .png or .svg" in told.stderr) == (2, True)


def test_output_that_cannot_be_written(tmp_path: Path) -> None:
    """A file where a folder should be, a folder that is not there, something that is no file."""
    recording = write(tmp_path / "r.mcap", depth())
    (tmp_path / "file").touch()
    assert_one_line(run("slam", recording, "-o", tmp_path / "file" / "run"), "cannot use")
    source = seven_scenes(tmp_path / "source")
    for out, line in {
        tmp_path / "none" / "o.mcap": "No such file or directory",
        tmp_path / "file" / "o.mcap": "Not a directory",
        Path("/dev/null"): "it exists and is not a file",
    }.items():
        assert_one_line(run("import", "7scenes", source, out), line)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["file", "r.mcap", "source"]


def test_a_recording_is_not_imported_over_itself(tmp_path: Path) -> None:
    """Under whatever name."""
    path = write(tmp_path / "r.mcap", depth())
    (tmp_path / "same.mcap").symlink_to(path)
    content = path.read_bytes()
    for out in (path, tmp_path / "same.mcap"):
        assert_one_line(run("import", "bag", path, out), "is what is imported")
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    "arguments",
    [
        ["calibrate", "{other}", "-o", "{recording}", "--no-field"],
        ["calibrate", "{recording}", "-o", "{recording}", "--no-field"],
        ["report", "{other}", "-o", "{recording}"],
        ["import", "7scenes", "{source}", "{recording}"],
        ["synth", "objects", "{recording}", "--frames", "2"],
    ],
)
def test_a_recording_is_not_replaced(arguments: list[str], tmp_path: Path) -> None:
    """By an output of any kind, named by mistake."""
    recording, other = (write(tmp_path / name, depth()) for name in ("r.mcap", "other.mcap"))
    content, source = recording.read_bytes(), seven_scenes(tmp_path / "source")
    told = run(*(one.format(recording=recording, other=other, source=source) for one in arguments))
    assert_one_line(told, "it is a recording")
    assert recording.read_bytes() == content


def test_a_pixel_beside_the_image_is_refused_before_slam(tmp_path: Path) -> None:
    """In one line, and the camera has not been looked for."""
    recording, out = write(tmp_path / "r.mcap", depth()), tmp_path / "r.run"
    told = run("learn", recording, "-o", out, "--name", "mug", "--pixel", "40,7")
    assert_one_line(told, "pixel 40,7 is outside the image of 40x30")
    assert not (out / "slam.npz").exists()


def test_the_first_frame_that_is_wanted_tells_the_size(tmp_path: Path) -> None:
    """A driver that begins with an image of another mode, or another frame's name."""
    stamps = [SECOND_NS + one * SECOND_NS // 10 for one in range(4)]
    with Scribe(tmp_path / "r.mcap") as scribe:
        scribe.ros2("/c/camera_info", camera_info(stamps[0], (40, 30), K), stamps[0])
        first = image(stamps[0], "16UC1", MILLIMETRES[:15, :20], frame_id="other")
        scribe.ros2("/c/depth", first, stamps[0])
        for stamp in stamps[1:]:
            scribe.ros2("/c/depth", image(stamp, "16UC1", MILLIMETRES), stamp)
    whole, later = (
        run("info", tmp_path / "r.mcap", "--intrinsics", "35,36,18.5,15.25", *more, "--json")
        for more in ([], ["--start", "0.05"])
    )
    assert json.loads(whole.stdout)["depth_frames"] == 1
    assert (later.exit_code, json.loads(later.stdout)["depth_frames"]) == (0, 3), later.stderr


def test_numbers_and_every_count_frames_of_one_camera_alone(tmp_path: Path) -> None:
    """Of a topic on which two cameras take turns."""
    stamps = [SECOND_NS + one * SECOND_NS // 10 for one in range(6)]
    with Scribe(tmp_path / "r.mcap") as scribe:
        scribe.ros2("/c/camera_info", camera_info(stamps[0], (40, 30), K), stamps[0])
        for number, stamp in enumerate(stamps):
            frame_id = "camera" if number % 2 == 0 else "other"
            scribe.ros2("/c/depth", image(stamp, "16UC1", MILLIMETRES, frame_id=frame_id), stamp)

    whole, second = open_recording(tmp_path / "r.mcap"), ReadOptions(every=2)

    assert [frame.time_ns for frame in whole.chosen([1])] == stamps[2:3]
    assert list(whole.stamps_ns()) == stamps[::2]
    assert [frame.time_ns for frame in open_recording(tmp_path / "r.mcap", second)] == stamps[::4]


def test_frames_of_which_none_is_found_are_no_path(tmp_path: Path) -> None:
    """Images of nothing after the first: no run is made of them."""
    with Scribe(tmp_path / "r.mcap") as scribe:
        for number in range(3):
            stamp = SECOND_NS + number * SECOND_NS // 10
            scribe.ros2("/c/camera_info", camera_info(stamp, (40, 30), K), stamp)
            scribe.ros2("/c/depth", image(stamp, "16UC1", MILLIMETRES * (number == 0)), stamp)
    told = run("slam", tmp_path / "r.mcap", "-o", tmp_path / "run", "--quiet")
    assert_one_line(told, "no frame but the first was found")


def test_a_principal_point_far_from_any_image_is_none(tmp_path: Path) -> None:
    """As --intrinsics refuses it."""
    with Scribe(tmp_path / "r.mcap") as scribe:
        scribe.ros2("/c/camera_info", camera_info(SECOND_NS, (40, 30), (35.0, 36.0, 1e9, 15.0)), SECOND_NS)
        scribe.ros2("/c/depth", image(SECOND_NS, "16UC1", MILLIMETRES), SECOND_NS)
    assert_one_line(run("slam", tmp_path / "r.mcap", "-o", tmp_path / "run"), "a principal point at 1e+09")


@pytest.mark.parametrize("closed", [">&-", "2>&-"])
def test_a_job_without_output_does_its_work(closed: str, tmp_path: Path) -> None:
    """Of cron, or of a daemon that closed the streams."""
    recording = write(tmp_path / "r.mcap", depth())
    command = f"{sys.executable} -m pipeline info {recording} {closed} > /dev/null"
    assert subprocess.run(["sh", "-c", command], check=False).returncode == 0


def test_a_full_disk_leaves_no_recording(tmp_path: Path, limited_files) -> None:
    """Neither whole nor partial."""
    source = seven_scenes(tmp_path / "source")
    with limited_files(4000):
        result = run("import", "7scenes", source, tmp_path / "o.mcap", "--quiet")
    assert_one_line(result, f"cannot write {tmp_path / 'o.mcap'}: File too large")
    assert [file.name for file in tmp_path.iterdir()] == ["source"]


@pytest.mark.parametrize("size", [0, 200, 2000])
def test_a_full_disk_leaves_no_run(
    size: int, mug_file: Path, true_trajectory: SlamResult, tmp_path: Path, limited_files
) -> None:
    """Whichever file of it does not fit; the same command works once there is room."""
    from pipeline.errors import PipelineError

    tracker = Tracker(true_trajectory)

    def work() -> None:
        with open_session(common(), RecordingSource(path=mug_file, said={}), tmp_path / "run") as session:
            tracker.stage(session, SlamConfig(particles=3))

    with pytest.raises(PipelineError, match="File too large") as caught, limited_files(size):
        work()
    assert str(tmp_path) in str(caught.value)
    assert not (tmp_path / "run").exists()
    work()
    assert (tmp_path / "run" / "trajectory.tum").exists()


def seven_scenes(folder: Path) -> Path:
    """Three depth images of noise that pack into some ten kilobytes."""
    folder.mkdir()
    rng = np.random.default_rng(5)
    for number in range(3):
        pixels = rng.integers(500, 4000, (48, 64)).astype(np.uint16)
        Image.fromarray(pixels).save(folder / f"frame-{number:06d}.depth.png")
    return folder


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--noise", "4"], "--noise needs --challenging"),
        (["--tables", "2", "--kinds", "stacked"], "--kinds needs --challenging"),
        (["--unasked", "others"], "--unasked needs --worlds"),
        (["--copies", "--share-search"], "about which --share-search says nothing"),
        (["--calibration", "--worlds", "3"], "about which --worlds says nothing"),
        (["--growth", "--keep", "rows"], "about which --keep says nothing"),
        (["--growth", "--tables", "3"], "about which --tables says nothing"),
        (["--lookalikes", "--copies"], "about which --copies says nothing"),
        (["--decoys", "--csv", "rows.csv"], "about which --csv says nothing"),
        (["--absent", "1", "--workers", "2"], "about which --workers says nothing"),
        (["--lookalikes", "--only", "mug"], "about which --only says nothing"),
        (["--data", "bop", "--objects", "3"], "about which --objects says nothing"),
        (["--proposals", "both", "--results", "a=b.csv"], "about which --results says nothing"),
    ],
)
def test_options_that_would_say_nothing(options: list[str], line: str) -> None:
    """A bench that ignored them would measure something else than was asked for."""
    told = run("bench", "poses", *options)
    assert told.exit_code == 2
    assert line in told.output.replace("\n", " ")


@pytest.mark.parametrize(
    ("command", "setting", "line"),
    [
        ("objects", "height_m=inf", "height_m must be a finite number"),
        ("objects", "room.width_m=inf", "width_m must be a finite number"),
        ("objects", "sensor.scale_error=nan", "scale_error must be a finite number"),
        ("scenes", "spread_m=inf", "spread_m must be a finite number"),
        ("challenging", "table_radius_m=inf", "table_radius_m must be a finite number"),
        ("challenging", "aim_error_deg=-5", "aim_error_deg must lie within"),
        ("worlds", "distance_m=[0.7, inf]", "distance_m must be a finite number"),
        ("worlds", "aim_error_deg=-5", "aim_error_deg must lie within"),
        ("worlds", "elevation_deg=[100, 120]", "elevation_deg must be two angles"),
    ],
)
def test_scenes_are_described_by_usable_numbers(
    command: str, setting: str, line: str, tmp_path: Path
) -> None:
    """Settings that describe no scene are told as such, and nothing is written."""
    told = run("synth", command, tmp_path / "out.mcap", "-s", f"synth.{setting}")
    assert told.exit_code == 2
    assert line in told.stderr
    assert told.stderr.count("\n") == 1
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("views", ["nan", "5.9", "0", "5,"])
def test_numbers_of_views_are_whole(views: str) -> None:
    """A number that is none is not rounded."""
    told = run("bench", "shapes", "--meshes", ".", "--views", views)
    assert (told.exit_code, f"--views {views}: " in told.stderr) == (2, True)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("bench air --lattice 2 --csv air.csv", "--csv is for a bench without --lattice only"),
        ("bench air --lattice 2 --lamp any", "--lamp is for a bench without --lattice only"),
        ("bench occlusion --drawn 2 --scenes 3", "--scenes is for a bench without --drawn only"),
        ("eval slam RUN --reference a.tum -s recording.every=0", "no section 'recording' here"),
        ("export RUN --format ply -o OUT --truth a", "--truth is for overlay only"),
        ("export RUN --format ply -o OUT --density 3", "--density is for mjcf and urdf only"),
        ("export RUN --format ply -o OUT --ids a.json", "--ids is for bop only"),
        ("export RUN --format ply -o OUT --recording a", "--recording is for --mesh and overlay only"),
        ("export RUN --format glb -o OUT --units mm", "--units is for ply, obj, stl only"),
        ("info a.mcap -s run.sede=3", "there is no setting run.sede"),
        ("parse a --shapes S -o RUN --colour only --region 0,0,0,1,1,1", "--region is for a parse of depth"),
        ("parse a --shapes S -o RUN --presence 0.1 --colour only", "--presence is for a parse of depth"),
        ("review RUN --frame 3", "--frame is for --screenshot only"),
        ("review RUN --from-mcap --truth a.tum", "--truth is for a run folder only"),
        ("review RUN --port 9000", "--port is for --web only"),
        ("review RUN --rebuild --truth a.tum", "--rebuild is for a review without --truth"),
        ("review RUN --size 64x64", "--size is for --screenshot only"),
        ("review RUN --web --screenshot a.png", "--web is for a review without --screenshot only"),
    ],
)
def test_options_that_say_nothing_are_refused(arguments: str, line: str) -> None:
    """One line says whose they are."""
    told = run(*arguments.split())
    assert (told.exit_code, told.stdout) == (2, "")
    assert line in told.stderr
    assert told.stderr.count("\n") == 1
