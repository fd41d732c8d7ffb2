"""Links lead somewhere, commands and options that the pages name exist, and the examples run."""

import importlib.util
import re
import shlex
import sys
from pathlib import Path
from types import ModuleType

import click
import pytest

from pipeline import interface
from pipeline.cli import voxscene
from shapes.prior import ShapePrior

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
COMMAND = re.compile(r"^    (voxscene .+)$|`(voxscene [^`]+)`", re.MULTILINE)


def commands(text: str) -> list[str]:
    """What a page tells the reader to type, comments left out."""
    return [
        (block or inline).split("  #")[0].strip()
        for block, inline in COMMAND.findall(re.sub(r"\\\n\s*", "", text))
    ]


def example(name: str) -> ModuleType:
    """An example as a module; `voxscene` is the interface, as in the wheel."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / "examples" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(autouse=True)
def package(monkeypatch: pytest.MonkeyPatch) -> None:
    """`import voxscene` without an installed wheel."""
    monkeypatch.setitem(sys.modules, "voxscene", interface)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files_that_are_there(page: Path) -> None:
    """Every one that is not an address."""
    for target in LINK.findall(page.read_text()):
        if not target.startswith(("http:", "https:", "#")):
            assert (page.parent / target.partition("#")[0]).exists(), f"{page.name}: {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_and_options_exist(page: Path) -> None:
    """Each command by its words; each option that is written with it."""
    for line in commands(page.read_text()):
        words = shlex.split(line.replace("...", ""))[1:]
        found: click.Command = voxscene
        while words and isinstance(found, click.Group) and not words[0].startswith("-"):
            word = words.pop(0)
            inner = found.get_command(click.Context(found), word)
            assert inner is not None, f"{page.name}: {line}"
            found = inner
        known = {option for one in found.params for option in (*one.opts, *one.secondary_opts)}
        known |= {"--help", "-h", "--version"}
        given = {word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)}
        assert given <= known, f"{page.name}: {line}"


def test_the_readme_is_short() -> None:
    """Ninety lines at most: the rest stands in docs/."""
    assert len((ROOT / "README.md").read_text().splitlines()) <= 90


def test_a_shape_becomes_a_mesh(small_shape: ShapePrior, tmp_path: Path, capsys) -> None:
    """The example writes what trimesh reads, and tells both volumes."""
    small_shape.save(tmp_path / "mug.npz")
    example("shape_to_mesh").main(str(tmp_path / "mug.npz"), str(tmp_path / "mug.ply"))
    assert (tmp_path / "mug.ply").stat().st_size > 100
    assert "triangles" in capsys.readouterr().out


@pytest.mark.slow  # tests/pipeline/test_interface.py tracks through the same interface
def test_a_recording_is_tracked(mug_file: Path, capsys) -> None:
    """The example follows the mug's film to a centimetre of its truth."""
    example("track_a_recording").main(str(mug_file), particles=16)
    told = capsys.readouterr().out
    assert "6 frames" in told
    (apart_cm,) = re.findall(r"at most ([\d.]+) cm", told)
    assert float(apart_cm) < 1.0
