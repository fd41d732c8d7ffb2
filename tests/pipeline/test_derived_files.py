"""Files of a run folder are held against hashes: any that is damaged is mended; a full disk leaves none."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.config import Settings
from pipeline.errors import PipelineError
from pipeline.fingerprints import file_hash
from pipeline.options import Common, RecordingSource
from pipeline.run_access import open_run_folder
from pipeline.run_folder import RunFolder
from pipeline.session import open_session
from pipeline.views.viewer import rrds_of
from recordings.errors import RecordingError
from slam.result import SlamResult

NOT_DERIVED = {"log.txt"}
"""Grows with each command, and is read by people alone."""
OF_RERUN = {"run.rrd"}
"""Rerun gives its chunks new names each time."""
OF_CLOCKS = {"timing.json", "slam.json", "room.json", "published.json"}


def run_again(recording: Path, run: Path, trajectory: SlamResult, *, force: bool = False) -> None:
    """The command `slam`, whose tracker is perfect."""
    from pipeline.stages.room import room_stage

    common = Common(as_json=False, quiet=True, settings=Settings.read(None, ()))
    with open_session(common, RecordingSource(path=recording, said={}), run, force=force) as session:
        room_stage(session, session.stage("slam", SlamResult.load, lambda: trajectory, {}))


def contents(run: Path) -> dict[str, bytes]:
    """Every file that an undisturbed run would have with the same bytes."""
    left_out = NOT_DERIVED | OF_RERUN | OF_CLOCKS
    files = [path for path in run.rglob("*") if path.is_file() and path.name not in left_out]
    return {path.relative_to(run).as_posix(): path.read_bytes() for path in files}


def test_half_of_any_file_is_mended(mug_file: Path, true_trajectory: SlamResult, tmp_path: Path) -> None:
    """By the same command, one file at a time."""
    run = tmp_path / "run"
    run_again(mug_file, run, true_trajectory)
    expected = contents(run)
    assert RunFolder(run).changed == []
    files = sorted(path for path in run.rglob("*") if path.is_file() and path.name not in NOT_DERIVED)
    assert len(files) >= 13
    for path in files:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        run_again(mug_file, run, true_trajectory)
        assert contents(run) == expected, path
        assert path.name not in OF_RERUN or verified(path)


def test_a_value_that_is_made_again_is_told_again(
    mug_file: Path, true_trajectory: SlamResult, tmp_path: Path
) -> None:
    """Another value, warning or time of the same inputs; without any of them files stay as they are."""
    run_again(mug_file, tmp_path, true_trajectory)
    written_ns = (tmp_path / "run.mcap").stat().st_mtime_ns
    run_again(mug_file, tmp_path, true_trajectory)
    assert (tmp_path / "run.mcap").stat().st_mtime_ns == written_ns
    lost = np.arange(len(true_trajectory)) == 2
    run_again(mug_file, tmp_path, replace(true_trajectory, lost=lost), force=True)

    told = {name: json.loads((tmp_path / f"{name}.json").read_text()) for name in ("summary", "timing")}
    assert told["summary"]["slam"]["lost_frames"] == 1
    seconds = json.loads((tmp_path / "stages" / "slam.json").read_text())["seconds"]
    assert told["timing"]["slam"]["seconds"] == seconds


def test_views_of_a_run_that_was_cut_off_before_they_were_written_are_made_anew(
    mug_file: Path, true_trajectory: SlamResult, tmp_path: Path
) -> None:
    """Between the commit and them, and among them; others are shown as they are."""
    run_again(mug_file, tmp_path, true_trajectory)
    rrd, published = tmp_path / "run.rrd", tmp_path / "stages" / "published.json"
    rrd.write_bytes(b"of before")
    rrds_of(tmp_path)
    assert rrd.read_bytes() == b"of before"
    with open_run_folder(tmp_path, {mug_file.name: file_hash(mug_file)}, force=True) as run:
        run.stage("slam", SlamResult.load, lambda: true_trajectory, settings={}, inputs={})
    assert rrds_of(tmp_path) == [rrd]
    assert rrd.read_bytes() != b"of before"
    rrd.write_bytes(b"of before")
    published.unlink()
    rrds_of(tmp_path)
    assert rrd.read_bytes() != b"of before"


def verified(rrd: Path) -> bool:
    """Whether Rerun's own reader takes a file."""
    rerun = Path(sys.executable).with_name("rerun")
    return subprocess.run([rerun, "rrd", "verify", rrd], capture_output=True, check=False).returncode == 0


def test_a_full_disk_leaves_whole_files_and_the_same_command_goes_on(
    mug_file: Path, true_trajectory: SlamResult, tmp_path: Path, limited_files
) -> None:
    """Twenty limits over the sizes of all files: one error each, then the bytes of an undisturbed run."""
    whole = tmp_path / "whole"
    run_again(mug_file, whole, true_trajectory)
    expected = contents(whole)
    largest = max(path.stat().st_size for path in whole.rglob("*") if path.is_file())
    for share in range(20):
        run = tmp_path / str(share) / "whole"
        run.parent.mkdir()
        with limited_files(largest * share // 20), pytest.raises((PipelineError, RecordingError, OSError)):
            run_again(mug_file, run, true_trajectory)
        written = contents(run) if run.exists() else {}
        assert all(content == expected[name] for name, content in written.items() if content), share
        assert not [path for path in run.rglob("*") if "partial" in path.name]
        run_again(mug_file, run, true_trajectory)
        assert contents(run) == expected
        assert verified(run / "run.rrd")


def test_another_program_makes_everything_again(
    mug_file: Path, true_trajectory: SlamResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Old values are never served as new: a stage's fingerprint holds a hash of its sources."""
    run_again(mug_file, tmp_path, true_trajectory)
    before = json.loads((tmp_path / "stages" / "slam.json").read_text())
    monkeypatch.setattr("pipeline.session.source_hash", lambda *_: "another program")
    run_again(mug_file, tmp_path, true_trajectory)
    after = json.loads((tmp_path / "stages" / "slam.json").read_text())

    assert before["fingerprint"] != after["fingerprint"]
    assert after["machine"]["cores"] >= 1
