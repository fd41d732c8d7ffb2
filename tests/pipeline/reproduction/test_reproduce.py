"""One page holds the experiments; a second run measures nothing again."""

from pathlib import Path

import pytest

from pipeline.benchmarks.poses import RemainingTime
from pipeline.executors import executors_for
from pipeline.mesh_source import MeshSource
from pipeline.reproduction import pose_chapters
from pipeline.reproduction.reproduce import CHAPTERS, reproduce
from pipeline.reproduction.request import Request
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
        progress=RemainingTime(8, said.append),
    )
    page = reproduce(request, ["D", "E"]).html()

    assert said == ["section D", "section E"]
    assert page.count("data:image/png;base64,") >= 4
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert "https://" not in page
    assert "voxscene bench poses --challenging 1 --only box,can --seed 7" in page
    assert "100.0%" in page
    assert "without boxes" in page
    assert (tmp_path / "tables" / "challenging.csv").is_file()
    assert (tmp_path / "figures" / "challenging_curves.svg").is_file()
    tried = [len(one.tried) for one in columns]
    assert reproduce(request, ["D", "E"]).html() == page
    assert [len(one.tried) for one in columns] == tried
    assert set("CDEFO") == set(CHAPTERS)
