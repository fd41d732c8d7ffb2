"""`voxscene slam` and `learn` read depth alone: recorded poses and truth are there for `eval`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from click.testing import CliRunner
from mcap.reader import make_reader
from mcap.writer import Writer

from pipeline.commands.learn import command
from pipeline.errors import PipelineError
from pipeline.stages.slam import MANY_SEARCHED, slam_stage
from slam.filter.rival_motion import CERTAIN, Doubt


def _without_poses_and_truth(source: Path, target: Path) -> None:
    """A copy with the images and their cameras alone."""
    with source.open("rb") as reading, target.open("wb") as writing:
        reader, writer = make_reader(reading), Writer(writing)
        writer.start()
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if "camera" not in channel.topic or schema is None:
                continue
            if channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id
                )
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()


def test_truth_and_poses_change_no_byte(mug_file: Path, tmp_path: Path) -> None:
    """Trajectory, uncertainty, shape and summary are the same without the topics that give them away."""
    bare = tmp_path / "bare.mcap"
    _without_poses_and_truth(mug_file, bare)
    assert b"/truth/scene" in mug_file.read_bytes()
    assert b"/truth/scene" not in bare.read_bytes()
    for source, run in ((mug_file, "with"), (bare, "without")):
        options = ["--name", "mug", "--box", "-0.1,-0.1,0.6,0.1,0.1,0.8", "-s", "slam.particles=16"]
        options += ["--every", "3", "--quiet", "-o", str(tmp_path / run)]
        result = CliRunner().invoke(command, [str(source), *options], catch_exceptions=False)
        assert result.exit_code == 0, result.output

    for name in ("slam.npz", "trajectory.tum", "mug.npz", "summary.json"):
        files = [next((tmp_path / run).rglob(name)).read_bytes() for run in ("with", "without")]
        assert files[0] == files[1], name


def _warnings(
    monkeypatch: pytest.MonkeyPatch, frames: list[SimpleNamespace], lost: Sequence[int] = ()
) -> list[str]:
    """What the stage says of a recording whose frames give these reports, some of them lost."""

    def track(*given: Any, **_: Any) -> MagicMock:
        for info in frames:
            given[4](info)
        result = MagicMock(lost=np.isin(np.arange(len(frames)), lost))
        result.__len__.return_value = len(frames)
        return result

    monkeypatch.setattr("slam.tracking.track", track)
    session = MagicMock()
    session.look.return_value.frames = len(frames)
    session.stage.side_effect = lambda *given, **_: given[2]()
    monkeypatch.setattr("pipeline.stages.slam.room_stage", lambda *_: None)
    monkeypatch.setattr("pipeline.stages.slam.CheckpointKeeper", MagicMock())
    slam_stage(session)
    return [call.args[0] for call in session.warn.call_args_list]


def test_frames_that_are_searched_one_by_one_are_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """After ten in a row, with likely causes; nine, or a pause between, say nothing."""
    found, searched = (SimpleNamespace(unexpected=flag, doubt=CERTAIN) for flag in (False, True))

    said = _warnings(monkeypatch, [found] * 3 + [searched] * (2 * MANY_SEARCHED))
    silent = _warnings(monkeypatch, [searched] * (MANY_SEARCHED - 1) + [found] + [searched] * 3)

    assert len(said) == 1
    assert said[0].startswith(f"frames 3 to {MANY_SEARCHED + 2} had to be searched")
    assert "--depth-scale" in said[0]
    assert silent == []


def test_a_path_that_is_mostly_lost_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not where half is; where none but the first frame was found, there is none."""
    frames = [SimpleNamespace(unexpected=False, doubt=CERTAIN)] * 6

    assert _warnings(monkeypatch, frames, lost=[1, 2, 3]) == []
    assert _warnings(monkeypatch, frames, lost=[1, 2, 3, 4])[0].startswith("4 of 6 frames are lost")
    with pytest.raises(PipelineError, match="no frame but the first"):
        _warnings(monkeypatch, frames, lost=[1, 2, 3, 4, 5])


def test_frames_in_which_two_things_move_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """How many, from which to which; not where the spread is widened by millimetres."""
    wide, narrow = np.zeros((6, 8), np.float32), np.zeros((6, 8), np.float32)
    wide[0, 1], narrow[0, 1] = 0.1, 0.003
    still = SimpleNamespace(unexpected=False, doubt=CERTAIN)
    contested = SimpleNamespace(unexpected=False, doubt=Doubt(wide, 0.4))
    hardly = SimpleNamespace(unexpected=False, doubt=Doubt(narrow, 0.1))

    assert _warnings(monkeypatch, [still, *[contested] * 4, hardly]) == []
    said = _warnings(monkeypatch, [still, contested, still, *[contested] * 3, hardly, contested])

    assert len(said) == 1
    assert said[0].startswith("in 5 frames, 1 to 7, two things move")
    assert "--mask" in said[0]
    assert _warnings(monkeypatch, [still, hardly]) == []
