"""A truth of another recording is told as such; one that was moved or cut is taken."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from mcap.reader import make_reader
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

from pipeline.cli import voxscene
from pipeline.config import Settings
from pipeline.evaluation.same_recording import truth_options
from pipeline.evaluation.truth import RecordedTruth
from pipeline.options import Common, RecordingSource
from pipeline.run_folder import RunFolder
from pipeline.session import open_session
from pipeline.stages.room import room_stage
from pipeline.synthesis.filming import film_object
from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.paths import PathConfig
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import CameraConfig, ObjectScene
from pipeline.synthesis.writing import write_recording
from pipeline.views.viewer import rrd_with_truth
from recordings.options import ReadOptions
from recordings.reading import open_recording
from recordings.types import Frame
from recordings.writer import CAMERA_TOPIC, RecordingWriter
from slam.result import SlamResult
from tests.pipeline.publishing.test_any_value import some_frames


@pytest.fixture
def run(mug_file: Path, true_trajectory: SlamResult, tmp_path: Path) -> Path:
    """Tracked through the mug's recording, with its views."""
    common = Common(as_json=False, quiet=True, settings=Settings({}))
    with open_session(common, RecordingSource(path=mug_file, said={}), tmp_path / "run") as session:
        slam = session.stage("slam", SlamResult.load, lambda: true_trajectory, {})
        room_stage(session, slam)
    return tmp_path / "run"


@pytest.fixture(scope="module")
def other_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A box in a room, filmed at the same stamps."""
    scene = ObjectScene(
        camera=CameraConfig(width=96, height=72),
        room=RoomConfig(kind="cluttered"),
        path=PathConfig(frames=6, degrees_per_frame=12.0, radius_m=1.5),
    )
    path = tmp_path_factory.mktemp("other") / "box.mcap"
    write_recording(film_object("box", built_in_object("box"), scene, 9), path)
    return path


def write_frames(path: Path, film: SyntheticRecording, frames: list[Frame]) -> Path:
    """Depth and true poses of some frames of a film."""
    poses = dict(zip(film.trajectory.times_ns.tolist(), film.trajectory.reference_from_camera, strict=True))
    with RecordingWriter(path, film.intrinsics) as writer:
        for frame in frames:
            writer.write_camera_pose(frame.time_ns, poses[frame.time_ns])
            writer.write_depth(frame)
    return path


def eval_slam(run: Path, reference: Path) -> Result:
    """The command."""
    return CliRunner().invoke(voxscene, ["eval", "slam", str(run), "--reference", str(reference)])


def test_the_truth_of_another_recording_is_an_error(run: Path, other_file: Path) -> None:
    """In one line, with exit code 1, whatever asks for it."""
    for command in (["eval", "slam", str(run), "--reference"], ["review", str(run), "--truth"]):
        result = CliRunner().invoke(voxscene, [*command, str(other_file)])
        assert (result.exit_code, result.stderr.count("\n")) == (1, 1), result.output
        assert f"{other_file} is not the recording of {run}, which was made from mug.mcap" in result.stderr
    assert not (run / "run.truth.rrd").exists()


def test_a_truth_is_read_as_the_run_read_its_recording(
    run: Path, mug_file: Path, true_trajectory: SlamResult, tmp_path: Path
) -> None:
    """Of a recording that does not tell its camera, by the one that the user told; of all its frames."""
    untold = tmp_path / "untold.mcap"
    with mug_file.open("rb") as reading, untold.open("wb") as writing:
        writer = Writer(writing)
        writer.start()
        for schema, channel, message in make_reader(reading).iter_messages():
            if schema is None or channel.topic == CAMERA_TOPIC:
                continue
            known = writer.register_schema(schema.name, schema.encoding, schema.data)
            topic = writer.register_channel(channel.topic, channel.message_encoding, known)
            writer.add_message(topic, message.log_time, message.data, message.publish_time)
        writer.finish()
    camera = open_recording(mug_file).intrinsics
    said = {"intrinsics": (camera.fx, camera.fy, camera.cx, camera.cy), "every": 2}
    common = Common(as_json=False, quiet=True, settings=Settings({}))
    half = some_frames(true_trajectory, slice(None, None, 2))
    with open_session(common, RecordingSource(path=untold, said=said), tmp_path / "half") as session:
        session.stage("slam", SlamResult.load, lambda: half, {})

    for truth in (untold, mug_file):
        path = rrd_with_truth(tmp_path / "half", truth)
        assert path.is_file()
    assert len(RecordedTruth(untold, truth_options(RunFolder(tmp_path / "half"), "slam")).trajectory) == 6
    assert truth_options(RunFolder(run), "parse") == ReadOptions()


def test_another_recording_is_not_exported(run: Path, other_file: Path, tmp_path: Path) -> None:
    """The room of a run is not fused of what another camera saw."""
    out = tmp_path / "out"
    command = ["export", str(run), "--mesh", "--recording", str(other_file), "-o", str(out), "--quiet"]
    result = CliRunner().invoke(voxscene, command)
    assert (result.exit_code, result.stderr.count("\n")) == (1, 1), result.output
    assert f"{other_file} is not the recording of {run}, which was made from mug.mcap" in result.stderr
    assert not out.exists()


def test_a_recording_that_was_moved_or_cut_is_taken(
    run: Path, mug_file: Path, filmed_mug: SyntheticRecording, tmp_path: Path
) -> None:
    """Without a word: its bytes or its frames are those of the run."""
    moved = tmp_path / "elsewhere" / "cup.mcap"
    moved.parent.mkdir()
    shutil.copy(mug_file, moved)
    frames = [replace(frame, rgb=None) for frame in list(filmed_mug)[2:5]]
    for truth in (moved, write_frames(tmp_path / "cut.mcap", filmed_mug, frames)):
        result = eval_slam(run, truth)
        assert (result.exit_code, result.stderr) == (0, "")


def test_what_cannot_be_told_is_a_warning(run: Path, filmed_mug: SyntheticRecording, tmp_path: Path) -> None:
    """Stamps that no view has, and images that agree in part."""
    half = [replace(one, depth_m=np.where(np.arange(96) < 30, 9.0, one.depth_m)) for one in filmed_mug]
    partly = write_frames(tmp_path / "partly.mcap", filmed_mug, half)
    assert "is it the right truth?" in eval_slam(run, partly).stderr
    (run / "room.npz").unlink()
    result = eval_slam(run, partly)
    assert (result.exit_code, "no frame tells" in result.stderr) == (0, True)


def test_a_trajectory_is_known_by_the_recording_beside_it(
    run: Path, mug_file: Path, other_file: Path, filmed_mug: SyntheticRecording, tmp_path: Path
) -> None:
    """Of its name, or the only one there; never for certain."""
    poses, times_ns = filmed_mug.trajectory.reference_from_camera, filmed_mug.trajectory.times_ns
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    truth = tmp_path / "truth.tum"
    np.savetxt(truth, np.column_stack([times_ns / 1e9, poses[:, :3, 3], turns]))
    assert eval_slam(run, truth).stderr == ""
    shutil.copy(mug_file, tmp_path / "mug.mcap")
    assert eval_slam(run, truth).stderr == ""
    shutil.copy(other_file, tmp_path / "truth.mcap")
    result = eval_slam(run, truth)
    assert (result.exit_code, f"{truth} lies beside" in result.stderr) == (0, True)
