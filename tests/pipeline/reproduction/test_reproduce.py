"""One page holds the experiments, and what was measured is kept."""

import shutil
import subprocess
from pathlib import Path

import pytest

from pipeline.benchmarks.poses import RemainingTime, kept_images
from pipeline.executors import executors_for
from pipeline.figures.canvas import panels, write_figure
from pipeline.mesh_source import MeshSource
from pipeline.report.page import Page
from pipeline.reproduction import pose_chapters
from pipeline.reproduction.reproduce import CHAPTERS, reproduce
from pipeline.reproduction.request import Request
from pipeline.synthesis.challenging_scene import KINDS, ChallengingScene
from pipeline.synthesis.scenarios import CameraConfig
from tests.pipeline.benchmarks.test_poses import Truthful


class Column(Truthful):
    """A method that keeps its seed to itself."""

    def of(self, seed: int, learned_views: int) -> "Column":
        """As our columns are asked."""
        assert (seed, learned_views) == (7, 0)
        return self


def test_the_page_holds_tables_curves_and_outlines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a truthful method and one that misses the box: no network, rows kept, the same page."""
    columns = (Column(), Column(title="without boxes", misses=("box",)))
    monkeypatch.setattr(pose_chapters, "OURS", columns)
    monkeypatch.setattr(pose_chapters, "KINDS", {kind: KINDS[kind] for kind in ("single", "partial")})
    small = ChallengingScene(camera=CameraConfig(width=160, height=120))
    monkeypatch.setattr(pose_chapters, "ChallengingScene", lambda: small)
    executors, at_once = executors_for(1)
    said: list[str] = []
    for part in ("tables", "figures"):
        (tmp_path / part).mkdir()
    request = Request(
        out=tmp_path,
        shapes=MeshSource(names=("box", "can")),
        images=1,
        data=None,
        peers=(),
        seed=7,
        executors=executors,
        at_once=at_once,
        say=said.append,
        progress=RemainingTime(8, said.append, lambda *_: None),
    )
    page = reproduce(request, ["D", "E"]).html()

    assert said == ["section D", "section E"]
    assert page.count("data:image/png;base64,") >= 3
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert "https://" not in page
    assert "voxscene bench poses --challenging 1 --only box,can --seed 7" in page
    assert "100.0%" in page
    assert "without boxes" in page
    assert (tmp_path / "tables" / "challenging.csv").is_file()
    assert (tmp_path / "figures" / "challenging_curves.svg").is_file()
    kept = list(kept_images(pose_chapters.challenging_source(request), columns, request.rows))
    assert [len(found) for _, found in kept] == [2, 2]
    assert set("CDEFLO") == set(CHAPTERS)


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
