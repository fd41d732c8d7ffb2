"""`voxscene info` and `voxscene import` keep their contract with other programs."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from mcap.writer import Writer

from pipeline.cli import voxscene
from recordings.types import CameraIntrinsics, Frame
from recordings.writer import MessageSchema, RecordingWriter
from tests.recordings.samples import Scribe, camera_info, image

FIELDS = ["depth_frames", "width", "height", "fx", "fy", "cx", "cy", "duration_s", "topics"]
FIELDS += ["lost_messages", "lost_chunks", "verified"]
FIELDS += ["depth_m", "measured_share", "identical_frames", "stamp_steps_back", "undecodable"]
FIELDS += ["coloured_frames", "warnings"]
CAMERA = CameraIntrinsics(width=8, height=6, fx=10.0, fy=11.0, cx=3.5, cy=2.5)


@pytest.fixture
def recording(tmp_path: Path, seed: int) -> Path:
    """Ten frames, with a gap of a second before the last."""
    rng = np.random.default_rng(seed)
    path = tmp_path / "r.mcap"
    with RecordingWriter(path, CAMERA) as writer:
        for time_ns in [*range(0, 900_000_000, 100_000_000), 1_800_000_000]:
            depth_m = rng.uniform(0.5, 2, (6, 8)).astype(np.float32)
            writer.write_depth(Frame(time_ns=10**9 + time_ns, depth_m=depth_m))
            writer.write_camera_pose(10**9 + time_ns, np.eye(4))
    return path


def run(*arguments: object) -> Result:
    """The command line, in this process."""
    return CliRunner().invoke(voxscene, [str(argument) for argument in arguments])


def test_json_is_one_document_with_the_promised_fields(recording):
    """--json prints the fields of the contract and nothing else; --hash adds the hashes."""
    result = run("info", recording, "--json", "--hash")
    document = json.loads(result.stdout)

    assert result.exit_code == 0
    assert list(document) == [*FIELDS, "frame_hashes"]
    assert list(json.loads(run("info", recording, "--json").stdout)) == FIELDS
    assert [document[key] for key in FIELDS[:7]] == [10, 8, 6, 10.0, 11.0, 3.5, 2.5]
    assert document["duration_s"] == pytest.approx(1.8)
    assert document["topics"]["/tf"]["messages"] == 10
    assert (document["lost_messages"], document["lost_chunks"], document["verified"]) == (0, 0, True)


def test_hashes_are_those_of_the_frames(recording):
    """Each hash is the sha256 of a frame's float32 metres, row by row."""
    from recordings.reading import open_recording

    document = json.loads(run("info", recording, "--json", "--hash").stdout)
    expected = [hashlib.sha256(frame.depth_m.tobytes()).hexdigest() for frame in open_recording(recording)]
    assert document["frame_hashes"] == expected


def test_text_tells_a_person_the_same(recording):
    """Frames, size, camera, gap and verdict are there to be read."""
    text = run("info", recording).stdout
    for part in ("10 frames of 8x6", "fx 10.000", "1 in the depth frames", "1 s at 0.800 s", "nothing lost"):
        assert part in text


def test_files_carried_along_are_told(tmp_path):
    """Attachments stand in the text with their kind and size."""
    path = tmp_path / "r.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_attachment(
            create_time=1, log_time=2, name="camera.yaml", media_type="application/yaml", data=b"fx: 1"
        )
        writer.finish()
    assert "camera.yaml (application/yaml, 5 bytes)" in run("info", path).stdout


def test_damage_is_exit_code_3(recording):
    """A cut recording is read as far as it goes; what is lost is told on stderr and in the document."""
    data = recording.read_bytes()
    recording.write_bytes(data[: len(data) // 4])
    result = run("info", recording, "--json")
    document = json.loads(result.stdout)
    assert result.exit_code == 3
    assert document["lost_chunks"] == 1
    assert "is damaged" in result.stderr


def test_a_recording_without_depth_is_no_error(tmp_path):
    """depth_frames is 0, there is no camera, and the exit code is 0."""
    path = tmp_path / "r.mcap"
    schema = MessageSchema(name="Note", encoding="jsonschema", data=b"{}", message_encoding="json")
    with RecordingWriter(path) as writer:
        writer.write("/notes", schema, b"{}", 10**9)
        writer.write("/notes", schema, b"{}", 3 * 10**9)
    result = run("info", path, "--json", "--hash")
    document = json.loads(result.stdout)
    assert result.exit_code == 0
    assert list(document) == FIELDS
    assert document["depth_frames"] == 0
    assert document["width"] is document["fx"] is None
    assert document["duration_s"] == 2.0
    assert "none: no topic holds 16-bit or float images" in run("info", path).stdout
    with RecordingWriter(tmp_path / "empty.mcap"):
        pass
    assert "depth   none: there is no message" in run("info", tmp_path / "empty.mcap").stdout


def test_options_reach_the_reader(recording):
    """Every option of reading changes what is read."""
    document = json.loads(
        run(
            "info",
            recording,
            "--json",
            "--start",
            0.1,
            "--end",
            0.75,
            "--every",
            2,
            "--intrinsics",
            "9,9,3,3",
        ).stdout
    )
    assert document["depth_frames"] == 4
    assert document["fx"] == 9.0


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["info", "MISSING"], 1),
        (["info", "EMPTY"], 1),
        (["info", "TEXT"], 1),
        (["info", "FOLDER"], 1),
        (["info", "RECORDING", "--depth-topic", "/nope"], 1),
        (["info", "RECORDING", "--every", "0"], 2),
        (["info", "RECORDING", "--intrinsics", "1,2,3"], 2),
        (["info", "RECORDING", "--depth-scale", "5000"], 2),
        (["info"], 2),
        (["import", "7scenes", "FOLDER", "OUT"], 1),
        (["import", "7scenes", "MISSING", "OUT"], 1),
        (["import", "bag", "TEXT", "OUT"], 1),
        (["import", "bag", "TEXT", "OUT", "--frames", "3"], 2),
        (["import", "magic", "FOLDER", "OUT"], 2),
        (["import", "tum", "FOLDER", "OUT", "--frames", "a:b"], 2),
    ],
)
def test_mistakes_end_in_one_line(arguments, code, recording, tmp_path):
    """Exit code 1 for input that cannot be used, with one line; 2 for usage; never a traceback."""
    places = {
        "MISSING": tmp_path / "missing.mcap",
        "EMPTY": tmp_path / "empty.mcap",
        "TEXT": tmp_path / "text.mcap",
        "FOLDER": tmp_path / "folder",
        "RECORDING": recording,
        "OUT": tmp_path / "out.mcap",
    }
    places["EMPTY"].touch()
    places["TEXT"].write_text("not a recording at all")
    places["FOLDER"].mkdir()
    result = run(*(places.get(argument, argument) for argument in arguments))

    assert result.exit_code == code
    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert result.stdout == ""
    if code == 1:
        assert len(result.stderr.splitlines()) == 1
        assert result.stderr.startswith("voxscene: ")
    assert not places["OUT"].exists()


def test_import_writes_what_info_reads(tmp_path):
    """A 7-Scenes folder goes in, a checked recording comes out."""
    from PIL import Image

    for i in range(3):
        pixels = np.full((6, 8), 1000 + i, np.uint16)
        Image.fromarray(pixels).save(tmp_path / f"frame-{i:06d}.depth.png")
    out = tmp_path / "out.mcap"
    result = run("import", "7scenes", tmp_path, out, "--intrinsics", "10,11,3.5,2.5", "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["recording"] == str(out)
    document = json.loads(run("info", out, "--json").stdout)
    assert (document["depth_frames"], document["fy"], document["verified"]) == (3, 11.0, True)


def test_a_principal_point_outside_the_image_is_a_warning(recording: Path) -> None:
    """On stderr and in the document; on its edge it is none."""
    for cx, told in ((900, True), (7.5, False)):
        result = run("info", recording, "--json", "--intrinsics", f"10,11,{cx},2.5")
        warned = [one for one in json.loads(result.stdout)["warnings"] if "principal point" in one]
        assert (result.exit_code, bool(warned), "outside the image of 8x6" in result.stderr) == (
            0,
            told,
            told,
        )


@pytest.mark.parametrize(("late_ns", "coloured"), [(0, 4), (50_000_000, 3), (10**9, 0)])
def test_colour_that_comes_with_no_frame_is_a_warning(late_ns: int, coloured: int, tmp_path: Path) -> None:
    """As of a colour camera with a clock of its own; how many frames have colour is told."""
    path, k = tmp_path / "r.mcap", (10.0, 11.0, 3.5, 2.5)
    with Scribe(path) as scribe:
        scribe.ros2("/d/camera_info", camera_info(10**9, (8, 6), k), 10**9)
        for stamp in range(10**9, 10**9 + 200_000_000, 50_000_000):
            scribe.ros2("/d/image", image(stamp, "16UC1", np.full((6, 8), 900, np.uint16)), stamp)
            colour = image(stamp + late_ns, "rgb8", np.zeros((6, 8, 3), np.uint8))
            scribe.ros2("/c/image", colour, stamp)
    document, text = json.loads(run("info", path, "--json").stdout), run("info", path)

    assert document["coloured_frames"] == coloured
    assert ("/c/image, with" in text.stdout) == (coloured < 4)
    assert any("no frame comes with colour" in one for one in document["warnings"]) == (coloured == 0)


def test_names_do_not_steer_the_terminal(tmp_path: Path) -> None:
    """A topic may hold any characters; they are shown, in every line that names it."""
    path = tmp_path / "r.mcap"
    with Scribe(path) as scribe:
        scribe.ros2("/d/\x1b[31mdepth", image(10**9, "16UC1", np.full((6, 8), 900, np.uint16)), 10**9)
    result = run("info", path, "--intrinsics", "10,11,3.5,2.5")

    assert result.stdout.count("/d/\\x1b[31mdepth") == 2
    assert "\x1b" not in result.stdout
