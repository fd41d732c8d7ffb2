"""Tables drawn from the model, and how calibration on them is judged."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.benchmarks.calibration import (
    ASKED,
    CalibrationRow,
    calibration_figures,
    calibration_lines,
    judge_drawn,
)
from pipeline.mesh_source import MeshSource

ROW = CalibrationRow(
    table=0,
    shape="can",
    sizes_drawn=False,
    there=True,
    leans=False,
    presence=0.9,
    error_m=0.002,
    level=0.4,
    ranks=(0.2, 0.5, 0.7),
)


def test_figures_by_law() -> None:
    """Poses count where they are told; both laws of sizes have their lines, and what lies at rest has."""
    absent = replace(ROW, there=False, presence=0.2, error_m=float("inf"), level=None, ranks=())
    figures = calibration_figures([ROW, absent, replace(ROW, table=1, sizes_drawn=True, level=0.97)])
    every = figures["laws"]["all"]
    assert (every["tables"], every["asked"], every["there"], every["poses"]) == (2, 3, 2, 2)
    assert every["inside"] == {"50%": 0.5, "90%": 0.5, "95%": 0.5}
    assert every["log_loss"] == pytest.approx(-np.log([0.9, 0.8, 0.9]).mean())
    assert len(calibration_lines(figures)) == 8


@pytest.mark.slow
def test_a_drawn_table_is_parsed() -> None:
    """A table of the built-in shapes, drawn twice alike: some 100 seconds of compiling for these images."""
    shapes = MeshSource.of(None, None, None)
    rows = judge_drawn(shapes, 0, 3)
    assert len(rows) == ASKED
    assert all(0 <= row.presence <= 1 for row in rows)
    assert rows == judge_drawn(shapes, 0, 3)
