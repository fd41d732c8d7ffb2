"""The command line starts fast, ends mistakes in one line, and keeps stdout for results."""

import json
import os
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from pipeline.cli import LazyGroup, voxscene
from pipeline.errors import ConfigError, PipelineError
from pipeline.options import Common, common_options
from recordings.errors import RecordingError

HEAVY = ("jax", "open3d", "numpy", "rerun", "pydantic", "trimesh")


@pytest.mark.parametrize("arguments", [["--help"], ["synth", "--help"]])
def test_help_imports_nothing_heavy(arguments: list[str]) -> None:
    """Start-up stays under half a second only so."""
    script = (
        "import sys; from click.testing import CliRunner; from pipeline.cli import voxscene; "
        f"assert CliRunner().invoke(voxscene, {arguments!r}).exit_code == 0; "
        f"print([name for name in {HEAVY!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)

    assert done.stdout.strip() == "[]"


def test_help_is_quick() -> None:
    """Half a second of processor time for the whole process, of which a busy machine takes no more."""
    child = subprocess.Popen([sys.executable, "-m", "pipeline", "--help"], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)

    assert child.returncode == 0
    assert usage.ru_utime + usage.ru_stime < 0.5


def leaves(group: click.Group, words: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], click.Command]]:
    """Every command below a group with the words that call it."""
    found = []
    for name in group.list_commands(click.Context(group)):
        command = group.get_command(click.Context(group), name)
        assert command is not None
        assert command.name == name
        found.append(((*words, name), command))
        if isinstance(command, click.Group):
            found += leaves(command, (*words, name))
    return found


@pytest.mark.parametrize(
    ("words", "command"), [pytest.param(*leaf, id=" ".join(leaf[0])) for leaf in leaves(voxscene)]
)
def test_every_command_has_help_and_stands_in_the_readme(
    words: tuple[str, ...], command: click.Command
) -> None:
    """One sentence at least, and where a newcomer looks."""
    readme = (Path(__file__).parents[2] / "README.md").read_text()

    assert command.get_short_help_str()
    assert f"voxscene {' '.join(words)}" in readme or isinstance(command, click.Group)


@pytest.mark.parametrize("words", [[], ["bench"], ["eval"], ["synth"]])
def test_lists_of_commands_are_not_cut_off(words: list[str]) -> None:
    """In a terminal of 80 columns."""
    listed = CliRunner().invoke(voxscene, [*words, "--help"], terminal_width=80).stdout
    lines = listed.split("Commands:")[1].strip().splitlines()

    assert lines
    assert all(line.endswith(".") and not line.endswith("...") for line in lines)


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (PipelineError("no room"), "voxscene: no room\n"),
        (ConfigError("no setting"), "voxscene: no setting\n"),
        (RecordingError("two\nlines"), "voxscene: two lines\n"),
        (
            FileNotFoundError(2, "No such file or directory", "x.mcap"),
            "voxscene: x.mcap: No such file or directory\n",
        ),
        (KeyboardInterrupt(), "voxscene: interrupted; nothing half-written is left\n"),
    ],
)
def test_mistakes_end_in_one_line(error: BaseException, line: str) -> None:
    """Without a traceback."""

    class Failing(LazyGroup):
        def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:  # noqa: ARG002
            @click.command(cmd_name)
            def fail() -> None:
                raise error

            return fail

    result = CliRunner().invoke(Failing("voxscene", package="", members=["fail"]), ["fail"])

    code = {ConfigError: 2, KeyboardInterrupt: 130}.get(type(error), 1)
    assert (result.exit_code, result.stdout, result.stderr) == (code, "", line)


@pytest.mark.parametrize(
    ("arguments", "interrupted", "goes_on"),
    [
        ("reproduce -o out", "pipeline.mesh_source.MeshSource.of", True),
        ("synth challenging out", "pipeline.mesh_source.MeshSource.of", True),
        ("bench poses --keep out", "pipeline.mesh_source.MeshSource.of", True),
        ("bench poses", "pipeline.mesh_source.MeshSource.of", False),
        ("bench shapes --keep out", "pipeline.mesh_source.MeshSource.of", True),
        ("bench shapes", "pipeline.mesh_source.MeshSource.of", False),
        ("bench air --csv out.csv", "pipeline.benchmarks.air.measure_air", True),
        ("bench slam", "pipeline.benchmarks.slam_cases.real_rows", False),
    ],
)
def test_an_interrupted_command_says_whether_it_goes_on(
    arguments: str, interrupted: str, goes_on: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """True of those that keep what they finished, false of others of the same last word."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(interrupted, interrupt)
    told = CliRunner().invoke(voxscene, arguments.split())
    how = "the same command goes on where it stopped" if goes_on else "nothing half-written is left"
    assert (told.exit_code, told.stderr.splitlines()[-1]) == (130, f"voxscene: interrupted; {how}")


def test_a_reader_that_stops_is_no_mistake(mug_file: Path) -> None:
    """As after `| head`: nothing is said."""
    read, write = os.pipe()
    os.close(read)
    words = [sys.executable, "-m", "pipeline", "info", str(mug_file)]
    done = subprocess.run(words, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (1, "")


def test_usage_mistakes_exit_with_two() -> None:
    """As click has it."""
    assert CliRunner().invoke(voxscene, ["nonsense"]).exit_code == 2
    assert CliRunner().invoke(voxscene, ["synth", "objects", "--frames", "x", "a.mcap"]).exit_code == 2


def test_results_are_one_json_document_or_lines() -> None:
    """And nothing with --quiet."""

    @click.command()
    @common_options("slam")
    def command(common: Common) -> None:
        common.report({"frames": 3, "seed": common.seed}, ["3 frames"])

    def out(*arguments: str) -> str:
        return CliRunner().invoke(command, arguments).stdout

    assert json.loads(out("--json", "--seed", "5")) == {"frames": 3, "seed": 5}
    assert out() == "3 frames\n"
    assert out("--quiet") == ""


def test_numbers_that_are_not_finite_are_null() -> None:
    """JSON has none: places that the prior excludes, errors of what was not found."""

    @click.command()
    @common_options("slam")
    def command(common: Common) -> None:
        common.report({"rows": [{"advantage": float("inf"), "error_m": 0.5}]}, [])

    result = CliRunner().invoke(command, ["--json"], catch_exceptions=False)
    assert json.loads(result.stdout) == {"rows": [{"advantage": None, "error_m": 0.5}]}


def test_synth_writes_a_recording(tmp_path: Path) -> None:
    """Named after the object that it is to hold; the same bytes for the same seed."""
    arguments = ["--frames", "2", "--size", "64x48", "--room", "bare", "--step", "5"]
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        path = tmp_path / name / "mug.mcap"
        result = CliRunner().invoke(voxscene, ["synth", "objects", str(path), *arguments, "--json"])
        assert result.exit_code == 0, result.output
        assert json.loads(result.stdout)[0]["objects"] == [{"name": "mug", "parent": "table"}]

    assert (tmp_path / "a" / "mug.mcap").read_bytes() == (tmp_path / "b" / "mug.mcap").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "exit_code", "message"),
    [
        (["objects", "--object", "spoon"], 1, "no object 'spoon'; there are bottle, bowl"),
        (["scenes", "--only", "mug,spoon"], 1, "no object 'spoon'"),
        (["scenes", "--size", "640"], 2, "--size 640: write WIDTHxHEIGHT"),
        (["scenes", "--size", "0x480"], 2, "--size 0x480: both sides must be 1 to 4096 pixels"),
        (["scenes", "--intrinsics", "1,2"], 2, "'1,2' is not four numbers"),
        (["scenes", "--intrinsics=-5,5,1,1"], 2, "intrinsics need pixels with fx, fy > 0"),
        (["scenes", "--elevations", "low"], 2, "--elevations low: write numbers"),
        (["scenes", "--meshes", "nowhere"], 1, "no folder of meshes nowhere"),
        (["scenes", "-s", "synth.frames=2"], 2, "no setting synth.frames"),
    ],
)
def test_synth_names_mistakes(tmp_path: Path, arguments: list[str], exit_code: int, message: str) -> None:
    """One line, and no file."""
    result = CliRunner().invoke(voxscene, ["synth", *arguments, str(tmp_path / "out.mcap")])

    assert result.exit_code == exit_code
    assert message in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_misspelt_command_is_told_which_it_may_have_been() -> None:
    """In groups too; far-off words are told nothing."""
    for words, near in ((["slm"], "slam"), (["eval", "pose"], "poses")):
        assert f"Did you mean {near}?" in CliRunner().invoke(voxscene, words).stderr
    assert "Did you mean" not in CliRunner().invoke(voxscene, ["xyz"]).stderr
