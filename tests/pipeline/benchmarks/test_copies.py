"""Tables with several things of one shape, and how counts are judged."""

from dataclasses import replace

import numpy as np
import pytest

import pipeline.benchmarks.pose_methods
import scene.parsing
from pipeline.benchmarks.copies import (
    COUNTS,
    OTHERS,
    CopiesRow,
    copies_figures,
    copies_lines,
    table_of_copies,
)
from pipeline.mesh_source import MeshSource
from scene.copies import shape_of


def test_a_table_holds_so_many_of_one_shape() -> None:
    """Two or three in turn, others beside them, all of them apart; the same at each call."""
    shapes = MeshSource.of(None, None, None)
    for number, count in enumerate(COUNTS):
        image, shape, told = table_of_copies(shapes, number, 5)
        of = [shape_of(one.shape, shapes.meshes) for one in image.objects]
        assert told == count == of.count(shape)
        assert len(of) == count + OTHERS == len(set(of)) + count - 1
        places = np.array([one.world_from_object[:3, 3] for one in image.objects])
        again = table_of_copies(shapes, number, 5)[0]
        np.testing.assert_array_equal(places, [one.world_from_object[:3, 3] for one in again.objects])


def test_counts() -> None:
    """A table counts where as many are told as there are, whatever lies where."""
    row = CopiesRow(
        table=0, shape="can", there=2, asked=3, found=2, expected=2.1, numbers=(0, 0, 0.9, 0.1), right=1
    )
    figures = copies_figures([row, replace(row, there=3, asked=4, right=2)])
    assert (figures["counts_right"], figures["tables"]) == (1, 2)
    assert (figures["things_right"], figures["things"]) == (3, 5)
    assert figures["there"] == pytest.approx(2.5)
    assert "1 of 2 counts right" in copies_lines(figures)[0]
    assert figures["numbers"]["likeliest_right"] == pytest.approx(0.5)
    assert figures["numbers"]["likeliest_told"] == pytest.approx(0.9)
    assert figures["numbers"]["log_loss"] == pytest.approx(-np.log([0.9, 0.1]).mean())
    assert copies_lines(copies_figures([])) == ["no table shows all of its copies"]


def test_the_bench_parses_as_the_program_does() -> None:
    """The function that `voxscene parse` calls."""
    assert pipeline.benchmarks.pose_methods.parse_scene is scene.parsing.parse_scene
