"""The bench of hidden objects on few draws."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from pipeline.benchmarks.occlusion import (
    OcclusionRow,
    drawn_figures,
    figures,
    measure_drawn_scenes,
    measure_occlusion,
    write_rows,
)
from pipeline.cli import voxscene
from pipeline.errors import PipelineError
from pipeline.synthesis.occluded_table import PLACES, occluded_table
from pipeline.synthesis.occlusion import SCENES, hidden_fraction, occlusion_camera, occlusion_scene


def test_the_order_of_the_supplements_figure(tmp_path: Path) -> None:
    """Turned < wide < closer, and the box there for certain: they differ by many standard errors."""
    rows = measure_occlusion(0, 0, 48, 4096, lambda *_: None)
    write_rows(tmp_path / "rows.csv", rows)

    told = figures(rows)
    assert told["in_order"]
    assert told["least_box"] > 0.99
    assert len((tmp_path / "rows.csv").read_text().splitlines()) == 4


def test_a_table_that_cannot_be_written_is_told_all_the_same(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """What was measured is printed before the file is written."""
    zeros: dict[str, Any] = dict.fromkeys((one.name for one in fields(OcclusionRow)), 0.0)
    rows = [OcclusionRow(**zeros | {"scene": scene, "there": False}) for scene in SCENES]

    def fail(*_: object) -> None:
        raise PipelineError("cannot write it: No space left on device")

    monkeypatch.setattr("pipeline.benchmarks.occlusion.measure_occlusion", lambda *_: rows)
    monkeypatch.setattr("pipeline.benchmarks.occlusion.write_rows", fail)
    told = CliRunner().invoke(voxscene, ["bench", "occlusion", "--csv", str(tmp_path / "rows.csv")])
    assert (told.exit_code, "No space left" in told.stderr) == (1, True)
    assert "turned < wide < closer: no" in told.stdout


def test_scenes_drawn_from_the_prior() -> None:
    """A mug in sight is told for certain; what is told where none is in sight is no certainty."""
    rows = measure_drawn_scenes(1, 4, 32, 4096, lambda *_: None)

    told = drawn_figures(rows)
    assert told["there"] == sum(row.there for row in rows)
    assert all(row.mug < 0.9 for row in rows if not row.there)
    assert any(row.mug > 0.999 for row in rows if row.there)


def test_an_empty_volume_hides_nothing_and_a_wall_hides_what_is_behind() -> None:
    """Against the cuboid's own share."""
    empty = occlusion_scene("empty", {}, {}, occlusion_camera(64), [0])
    assert hidden_fraction(empty) == 0

    empty.ideal_m[:] = 0.9
    assert abs(hidden_fraction(empty) - 0.5) < 0.01


@pytest.mark.parametrize("name", PLACES)
def test_a_mug_behind_the_box_is_not_seen(name: str) -> None:
    """Both stand on the table; of the mug the frame shows nothing, of the box everything."""
    box, mug = occluded_table(name, 0, mug=True).truth.objects

    assert box.visible_fraction == 1
    assert mug.visible_fraction == 0
