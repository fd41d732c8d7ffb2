"""A project whose recordings fail one by one: no other is touched, and a change costs itself alone."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from pipeline import project_run
from pipeline.cli import voxscene
from pipeline.config import Settings
from pipeline.options import Common
from pipeline.project import ProjectRecording, read_project
from pipeline.project_run import Row, run_project
from pipeline.run_access import open_run_folder
from pipeline.stages.room import room_stage
from slam.result import SlamResult

COMMON = Common(as_json=False, quiet=True, settings=Settings.read(None, ()))


def write_project(folder: Path, names: tuple[str, ...], more: str = "") -> Path:
    """A project that runs slam on recordings of these names, and a stage of `more`."""
    entries = "".join(f"[[recording]]\npath = '{name}.mcap'\nstage = 'slam'\n" for name in names)
    path = folder / "project.toml"
    path.write_text(entries + more)
    return path


@pytest.fixture
def perfect_tracker(monkeypatch: pytest.MonkeyPatch, true_trajectory: SlamResult) -> list[str]:
    """Slam finds the true path at once; the names of the recordings that it was computed for."""
    computed: list[str] = []

    def track(session):
        def compute() -> SlamResult:
            computed.append(session.source.path.stem)
            if session.source.path.stem == "bug":
                raise ZeroDivisionError("nobody foresaw this")
            return true_trajectory

        room_stage(session, session.stage("slam", SlamResult.load, compute, {}))

    monkeypatch.setattr(project_run, "slam_stage", track)
    return computed


def run(*arguments: object) -> Result:
    """The command line, in this process."""
    return CliRunner().invoke(voxscene, [str(argument) for argument in arguments])


@pytest.fixture
def folder(tmp_path: Path, mug_file: Path) -> Path:
    """Two good recordings, one that is none, and one whose tracking meets a mistake of the program."""
    for name in ("first", "last", "bug"):
        (tmp_path / f"{name}.mcap").write_bytes(mug_file.read_bytes())
    (tmp_path / "empty.mcap").write_bytes(b"")
    return tmp_path


def rows(found: list[Row]) -> dict[str, bool]:
    """Which recordings were done."""
    return {row.stem: row.failure is None for row in found}


@pytest.mark.parametrize(
    "command",
    ["eval slam RUN --reference", "eval poses RUN --truth", "eval shapes RUN --truth", "review RUN --truth"],
)
def test_a_projects_run_is_not_taken_for_that_of_a_recording(command: str, tmp_path: Path) -> None:
    """To begin it anew, as one without a stage, would cost all of it."""
    for folder in ("stages", "recordings/mug", "recordings/table"):
        (tmp_path / folder).mkdir(parents=True)
    told = run(*(str(tmp_path) if word == "RUN" else word for word in command.split()), "truth.mcap")

    assert told.exit_code == 1
    assert told.stderr.endswith(f"project; name {tmp_path}/recordings/STEM, of mug, table\n")


def test_every_mistake_is_told_before_anything_begins(folder: Path) -> None:
    """In one go: files, settings, names of shapes; exit code 2, and no run folder."""
    more = "[[recording]]\npath = 'bug.mcap'\nstage = 'learn'\nslam.particles = -3\n"
    more += "[[recording]]\npath = 'missing.mcap'\nstage = 'parse'\nobjects = ['bgu']\n"
    more += "[[recording]]\npath = 'last.mcap'\nstage = 'parse'\nobjects = ['bug:2']\n"
    result = run("run", write_project(folder, ("first", "empty"), more))
    lines = result.stderr.splitlines()

    assert result.exit_code == 2
    for mistake in (
        "empty.mcap is empty",
        "particles must lie",
        "missing.mcap: No such file",
        "no shape 'bgu'",
    ):
        assert sum(mistake in line for line in lines) == 1, mistake
    assert sum("no shape" in line for line in lines) == 1
    assert not (folder / "project.run").exists()


def test_what_is_not_understood_hides_no_other_mistake(folder: Path) -> None:
    """An unknown stage, and a file that is none; nothing is said of shapes that the first was to learn."""
    more = "[[recording]]\npath = 'first.mcap'\nstage = 'lern'\n"
    more += "[[recording]]\npath = 'last.mcap'\nstage = 'parse'\nobjects = ['first']\n"
    result = run("run", write_project(folder, ("empty",), more))

    assert result.exit_code == 2
    assert "got 'lern'" in result.stderr
    assert "empty.mcap is empty" in result.stderr
    assert "shape" not in result.stderr


def test_a_recording_that_fails_costs_no_other(folder: Path, perfect_tracker: list[str]) -> None:
    """Neither one that is none, nor one that meets a mistake of the program; both are told."""
    project = write_project(folder, ("empty", "first", "bug", "last"))
    result = run("run", project, "--keep-going")
    summary = json.loads((folder / "project.run" / "summary.json").read_text())

    assert result.exit_code == 1
    assert set(summary["recordings"]) == {"first", "last"}
    assert set(summary["failed"]) == {"empty", "bug"}
    assert "ZeroDivisionError" in summary["failed"]["bug"]["why"]
    assert "Traceback" in (folder / "project.run" / "recordings" / "bug" / "log.txt").read_text()
    assert "empty  failed: " in result.stdout
    assert "2 of 4 recordings done" in result.stdout
    assert perfect_tracker == ["first", "bug", "last"]


def test_a_switch_stops_at_the_first_failure(folder: Path, perfect_tracker: list[str]) -> None:
    """What is left is not begun."""
    project = write_project(folder, ("first", "bug", "last"))
    result = run("run", project, "--stop-at-failure")

    assert result.exit_code == 1
    assert perfect_tracker == ["first", "bug"]


def test_a_changed_recording_begins_anew_alone(
    folder: Path, perfect_tracker: list[str], mug_file: Path
) -> None:
    """The others stay as they are."""
    project = read_project(write_project(folder, ("first", "last")))
    run_project(project, folder / "run", COMMON)
    changed = bytearray(mug_file.read_bytes())
    changed[-1] ^= 1
    (folder / "last.mcap").write_bytes(changed)
    found = run_project(project, folder / "run", COMMON)

    assert rows(found) == {"first": True, "last": True}
    assert perfect_tracker == ["first", "last", "last"]


def test_force_begins_anew_in_the_folder_of_something_else(
    folder: Path, perfect_tracker: list[str], mug_file: Path
) -> None:
    """As the refusal without it advises."""
    with open_run_folder(folder / "project.run", {mug_file.name: "hash"}) as one:
        (one.path / "slam.npz").touch()
    project = write_project(folder, ("first",))
    refused = run("run", project)
    assert (refused.exit_code, "begin this one anew with --force" in refused.stderr) == (1, True)

    assert run("run", project, "--force").exit_code == 0
    assert perfect_tracker == ["first"]


def test_a_recording_that_looks_for_a_shape_that_failed_is_not_begun(folder: Path) -> None:
    """Where it was named; where all shapes are looked for, the others are, and that is told."""
    learn = "".join(f"[[recording]]\npath = '{n}.mcap'\nstage = 'learn'\n" for n in ("first", "bug"))
    parse = "[[recording]]\npath = 'last.mcap'\nstage = 'parse'\n"
    project = read_project(write_project(folder, (), learn + parse))
    table = next(one for one in project.recordings if one.stage == "parse")
    failed = {"bug": Row(stem="bug", path=folder / "bug.mcap", stage="learn", failure="no object")}

    def task(recording: ProjectRecording):
        return project_run._task(project, recording, folder / "run", COMMON, force=False, rows=failed)

    for asked in ("bug", "bug:2"):
        named = ProjectRecording(path=table.path, stage="parse", objects=(asked,))
        refused = task(named).call(*task(named).arguments)
        assert refused.failure == "the shape bug could not be learned"
    assert task(table).arguments[-1] == ("looked for all but bug, which could not be learned",)
