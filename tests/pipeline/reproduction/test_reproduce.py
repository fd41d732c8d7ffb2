"""One page holds the experiments, and what was measured is kept."""

import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import pytest
import trimesh
from click.testing import CliRunner

from pipeline.benchmarks.poses import ESTIMATE_AFTER, kept_images
from pipeline.benchmarks.shape_row import ShapeRow
from pipeline.cli import voxscene
from pipeline.executors import executors_for
from pipeline.figures.canvas import panels, write_figure
from pipeline.mesh_source import MeshSource
from pipeline.report.page import Page
from pipeline.reproduction import pose_chapters, shape_chapter
from pipeline.reproduction import reproduce as chapters
from pipeline.reproduction.reproduce import CHAPTERS, reproduce
from pipeline.reproduction.request import Request
from pipeline.synthesis.challenging_kinds import KINDS
from pipeline.synthesis.challenging_scene import ChallengingScene
from pipeline.synthesis.scenarios import CameraConfig
from tests.pipeline.benchmarks.test_poses import Truthful


class Column(Truthful):
    """A method that keeps its seed to itself."""

    def of(self, seed: int, learned_views: int) -> "Column":
        """As our columns are asked."""
        assert (seed, learned_views) == (7, 0)
        return self


def asked(out: Path, said: list[str], **about: Any) -> Request:
    """For one image of each kind of a box and a can."""
    executors, at_once = executors_for(1)
    for part in ("tables", "figures"):
        (out / part).mkdir()
    request = Request(
        out=out,
        shapes=MeshSource(names=("box", "can")),
        images=1,
        data=None,
        peers=(),
        seed=7,
        executors=executors,
        at_once=at_once,
        say=said.append,
        progress=lambda *_: None,
    )
    return replace(request, **about)


def test_the_page_holds_tables_curves_and_outlines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a truthful method and one that misses the box: no network, rows kept, the same page."""
    columns = (Column(), Column(title="without boxes", misses=("box",)))
    monkeypatch.setattr(pose_chapters, "OURS", columns)
    monkeypatch.setattr(pose_chapters, "KINDS", {kind: KINDS[kind] for kind in ("single", "partial")})
    small = ChallengingScene(camera=CameraConfig(width=160, height=120))
    monkeypatch.setattr(pose_chapters, "ChallengingScene", lambda: small)
    said: list[str] = []
    request = asked(tmp_path, said)
    page = reproduce(request, ["D", "E"]).html()

    assert said == ["section D", "section E"]
    assert page.count("data:image/png;base64,") >= 3
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert "https://" not in page
    assert "voxscene bench poses --challenging 1 --against '' --only box,can --seed 7" in unescape(page)
    assert "100.0%" in page
    assert "without boxes" in page
    assert (tmp_path / "tables" / "challenging.csv").is_file()
    assert (tmp_path / "figures" / "challenging_curves.svg").is_file()
    kept = list(kept_images(pose_chapters.challenging_source(request), columns, request.rows))
    assert [len(found) for _, found in kept] == [2, 2]
    assert set("CDEFLO") == set(CHAPTERS)


def test_commands_on_the_page_measure_what_it_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each is one that the program takes, with the numbers that the page was made with."""
    measured: dict[str, tuple] = {}

    def spy(name: str, answer: Any) -> Callable[..., Any]:
        def called(*arguments: Any, **options: Any) -> Any:
            measured.setdefault(name, (arguments, options))
            return answer

        return called

    def stop(*_: object, **__: object) -> Any:
        raise InterruptedError

    (tmp_path / "meshes").mkdir()
    trimesh.creation.box((100, 80, 60)).export(tmp_path / "meshes" / "box.ply")
    trimesh.creation.box((50, 80, 60)).export(tmp_path / "meshes" / "can.ply")
    request = asked(tmp_path, [], shapes=MeshSource(tmp_path / "meshes", "mm", ("can",)))
    figures = {"object": "can", "supplement": None, **dict.fromkeys(shape_chapter.FIGURES, 0.5)}
    rows = [ShapeRow(figures=figures, scored={})]
    monkeypatch.setattr(shape_chapter, "shape_rows", spy("shapes", rows))
    monkeypatch.setattr(chapters, "measure_occlusion", spy("occlusion", []))
    monkeypatch.setattr(chapters, "figures", lambda _: {"in_order": True})
    monkeypatch.setattr(chapters, "measure_sampler", stop)
    page = unescape(reproduce(request, ["C", "L"]).html())
    commands = [shlex.split(line)[1:] for line in re.findall(r"voxscene bench [^<\n]*", page)]
    assert [words[1] for words in commands] == ["shapes", "shapes", "occlusion"]

    shown = dict(measured)
    measured.clear()
    monkeypatch.setattr("pipeline.benchmarks.shapes.shape_rows", spy("shapes", iter(())))
    monkeypatch.setattr("pipeline.benchmarks.occlusion.measure_occlusion", stop)
    CliRunner().invoke(voxscene, commands[0])
    same = slice(1, 7)  # the objects that are learned, views, poses, peers, settings and seed
    assert measured["shapes"][0][same] == shown["shapes"][0][same]
    assert list(measured["shapes"][0][0]) == list(shown["shapes"][0][0]) == ["box", "can"]
    assert measured["shapes"][0][8] == shown["shapes"][0][8]
    assert measured["shapes"][1] == shown["shapes"][1]
    assert commands[2][2:] == ["--width", "64", "--draws", str(shown["occlusion"][0][3]), "--seed", "7"]


def test_each_section_has_an_estimate_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first images of a section say nothing of another's."""

    def chapter(request: Request, _page: Page) -> None:
        for done in range(ESTIMATE_AFTER + 1):
            request.progress(done, 100)

    monkeypatch.setattr(chapters, "CHAPTERS", {"E": chapter, "F": chapter})
    said: list[str] = []
    reproduce(asked(tmp_path, said), ["E", "F"])
    assert [line.split(":")[0] for line in said] == [
        "section E",
        f"{ESTIMATE_AFTER} of 100 images",
        "section F",
        f"{ESTIMATE_AFTER} of 100 images",
    ]


def test_the_page_opens_in_a_browser_without_a_network(tmp_path: Path) -> None:
    """Headless, with every address out of reach: chapter, table and picture are there."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no browser here")
    page = Page("Experiments", "seed 0")
    page.chapter("E. Poses")
    page.table(("images", "method"), [("all", "voxscene")])
    figure, _ = panels(1, 1, 1.0, 1.0)
    write_figure(figure, [tmp_path / "picture.png"])
    page.pictures({"a picture": (tmp_path / "picture.png").read_bytes()})
    (tmp_path / "report.html").write_text(page.html())
    words = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    words += ["--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={tmp_path / 'profile'}"]
    shown = subprocess.run(
        [*words, f"file://{tmp_path / 'report.html'}"],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    ).stdout

    assert "E. Poses" in shown
    assert "<td>voxscene</td>" in shown
    assert 'src="data:image/png' in shown
