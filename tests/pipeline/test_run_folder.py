"""Stages are computed once, committed whole, and survive a kill at any moment."""

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

from pipeline.errors import PipelineError
from pipeline.logs import log
from pipeline.run_access import open_run_folder
from pipeline.run_folder import RunFolder

INPUTS = {"room.mcap": "a" * 64}


@dataclass(frozen=True)
class Text:
    """The smallest value."""

    text: str

    def save(self, path: Path) -> None:
        """Write it."""
        path.write_text(self.text)

    @classmethod
    def load(cls, path: Path) -> "Text":
        """Read it."""
        return cls(path.read_text())


class Work:
    """Counts how often it is done."""

    def __init__(self, text: str = "value") -> None:
        self.times = 0
        self._text = text

    def __call__(self) -> Text:
        """Do it."""
        self.times += 1
        return Text(self._text)


def slam(
    run: RunFolder, work: Work, settings: Mapping[str, object] | None = None, recording: str = "a"
) -> Text:
    """A stage of that work."""
    settings = settings or {"slam": {"particles": 8}}
    return run.stage("slam", Text.load, work, settings=settings, inputs={"recording": recording}).value


def test_settings_that_make_a_stage_again_are_told(tmp_path: Path) -> None:
    """By name, with what they were, once; not of a stage that is unchanged, or made for the first time."""
    said = list[str]()
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: said.append(record.getMessage())  # type: ignore[method-assign]
    log.addHandler(handler)
    try:
        for particles in (8, 8, 16):
            run, settings = RunFolder(tmp_path), {"slam": {"particles": particles, "proposal": "enumerate"}}
            slam(run, Work(), settings)
            run.stage("room", Text.load, Work(), settings=settings, inputs={})
    finally:
        log.removeHandler(handler)

    assert said == ["slam is made again: slam.particles was 8"]


def test_an_unchanged_stage_is_not_run_again(tmp_path: Path) -> None:
    """Neither in the same process nor in the next."""
    work = Work()
    for _ in range(2):
        with open_run_folder(tmp_path / "run", INPUTS) as run:
            assert slam(run, work) == slam(run, work) == Text("value")

    assert work.times == 1


@pytest.mark.parametrize(
    "change", [{"settings": {"slam": {"particles": 9}}}, {"recording": "b"}], ids=["settings", "input"]
)
def test_a_changed_stage_is_run_again(tmp_path: Path, change: dict) -> None:
    """Whatever it depends on."""
    first, second = Work("old"), Work("new")
    with open_run_folder(tmp_path, INPUTS) as run:
        slam(run, first)
        assert slam(run, second, **change) == Text("new")

    assert (first.times, second.times) == (1, 1)


def test_a_damaged_value_is_computed_again(tmp_path: Path) -> None:
    """Its hash is part of the record."""
    with open_run_folder(tmp_path, INPUTS) as run:
        slam(run, Work())
        (run.path / "stages" / "published.json").write_text("{}")
        assert run.changed == []
        run.value_path("slam").write_text("damaged")
        assert run.record("slam") is None
        (changed,) = run.changed
        assert changed.startswith("slam.npz was changed or is of another version")
        assert slam(run, Work()) == Text("value")


def test_a_stage_that_fails_leaves_what_was_committed(tmp_path: Path) -> None:
    """With other settings, or the same with force."""

    def fail() -> Text:
        raise PipelineError("no object there")

    settings = {"slam": {"particles": 9}}
    with open_run_folder(tmp_path, INPUTS) as run:
        slam(run, Work())
    for force in (False, True):
        with open_run_folder(tmp_path, INPUTS, force=force) as run:
            with pytest.raises(PipelineError, match="no object"):
                run.stage("slam", Text.load, fail, settings=settings, inputs={})
            assert list(run.records()) == ["slam"]
            assert run.changed == []


def test_force_computes_again(tmp_path: Path) -> None:
    """Without any change."""
    work = Work()
    for _ in range(2):
        with open_run_folder(tmp_path, INPUTS, force=True) as run:
            slam(run, work)

    assert work.times == 2


def test_other_inputs_are_refused_without_force(tmp_path: Path) -> None:
    """The message names what the run was made from; with force nothing of it stays."""
    with open_run_folder(tmp_path, INPUTS) as run:
        slam(run, Work())
        run.stage("learn/mug", Text.load, Work("mug"), settings={}, inputs={})
        run.stage("sensor", Text.load, Work("noise"), settings={}, inputs={})
        for name in ("sensor.toml", "run.truth.rrd"):
            (run.path / name).touch()
    others = {"kitchen.mcap": "b" * 64}
    with (
        pytest.raises(PipelineError, match=r"made from room\.mcap.*--force"),
        open_run_folder(tmp_path, others),
    ):
        pass

    with open_run_folder(tmp_path, others, force=True) as run:
        assert run.records() == {}
        left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
        assert left == {"log.txt", "stages/inputs.json"}


def test_the_same_recording_under_another_name_is_accepted(tmp_path: Path) -> None:
    """Contents count."""
    with open_run_folder(tmp_path, INPUTS) as run:
        slam(run, Work())
    with open_run_folder(tmp_path, {"copy.mcap": "a" * 64}) as run:
        assert list(run.records()) == ["slam"]


def test_a_folder_of_other_things_is_not_touched(tmp_path: Path) -> None:
    """It is not empty and not a run folder."""
    (tmp_path / "thesis.txt").write_text("years of work")
    for force in (False, True):
        with (
            pytest.raises(PipelineError, match="not empty and not a run folder"),
            open_run_folder(tmp_path, INPUTS, force=force),
        ):
            pass

    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_folder_in_use_is_refused(tmp_path: Path) -> None:
    """One process at a time."""
    with (
        open_run_folder(tmp_path, INPUTS),
        pytest.raises(PipelineError, match="in use by another"),
        open_run_folder(tmp_path, INPUTS),
    ):
        pass


def test_unusable_paths_are_one_clear_error(tmp_path: Path) -> None:
    """A file where the folder should be."""
    (tmp_path / "file").write_text("")
    with pytest.raises(PipelineError, match="cannot use"), open_run_folder(tmp_path / "file", INPUTS):
        pass


def test_stages_are_listed_with_their_settings(tmp_path: Path) -> None:
    """By name, as plain values."""
    with open_run_folder(tmp_path, INPUTS) as run:
        slam(run, Work())
        run.stage("learn/mug", Text.load, Work(), settings={"learn": {"pitch_m": 0.005}}, inputs={})

        assert list(run.records()) == ["slam", "learn/mug"]
        record = run.record("learn/mug")
        assert record is not None
        assert record.settings == {"learn": {"pitch_m": 0.005}}
        assert record.seconds >= 0
        assert run.value_path("learn/mug") == tmp_path / "shapes" / "mug.npz"
        assert record.fingerprint != run.records()["slam"].fingerprint
        assert record.machine["cores"] >= 1


def test_what_a_stage_prints_does_not_reach_stdout(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """From Python or from below."""

    def noisy() -> Text:
        print("from Python")
        os.write(1, b"from C++\n")
        return Text("value")

    with open_run_folder(tmp_path, INPUTS) as run:
        run.stage("slam", Text.load, noisy, settings={}, inputs={})

    captured = capfd.readouterr()
    assert captured.out == ""
    assert "from C++" in captured.err


CHILD = """
import sys, time
from pathlib import Path
from tests.pipeline.test_run_folder import INPUTS, Text
from pipeline.run_access import open_run_folder
with open_run_folder(Path(sys.argv[1]), INPUTS) as run:
    print("begun", flush=True)
    for name in ("slam", "learn/mug", "parse"):
        inputs = {"recording": "a"}
        run.stage(name, Text.load, lambda: Text(name * 200_000), settings={}, inputs=inputs)
"""


def test_kill_at_any_moment_then_resume_ends_with_the_same_values(tmp_path: Path, seed: int) -> None:
    """SIGKILL after random delays; the last run is left alone."""

    def start(folder: Path) -> subprocess.Popen[str]:
        root = Path(__file__).parents[2]
        return subprocess.Popen(
            [sys.executable, "-c", CHILD, str(folder)], cwd=root, stdout=subprocess.PIPE, text=True
        )

    with start(tmp_path / "whole") as undisturbed:
        undisturbed.communicate()
    assert undisturbed.returncode == 0
    for attempt in range(4):
        with start(tmp_path / "killed") as child:
            assert child.stdout is not None
            child.stdout.readline()
            time.sleep((seed >> (4 * attempt) & 15) / 15 * 0.03)
            child.send_signal(signal.SIGKILL)
    with start(tmp_path / "killed") as last:
        last.communicate()
    assert last.returncode == 0

    for name in ("slam.npz", "parse.npz", "shapes/mug.npz"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    left_over = [path.name for path in (tmp_path / "killed").rglob("*") if "partial" in path.name]
    assert left_over == []
