"""What summary.json says of a parsed scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.commands.parse import _count_line, _not_found_lines
from pipeline.publishing.summary import summary_of
from pipeline.publishing.values import RunValues
from pipeline.surfaces import SceneSurface, Surfaces


def test_an_object_is_where_its_middle_is(parsed_run: RunValues) -> None:
    """Of a surface that begins at its frame's origin, as that of a learned shape."""
    corners = np.array([[0.0, 0.0, 0.0], [0.2, 0.1, 0.04]])
    surface = SceneSurface(vertices_m=corners, faces=np.zeros((1, 3), np.int64))
    values = replace(parsed_run, surfaces=Surfaces(dict.fromkeys(("mug", "box", "can"), surface)))

    mug = summary_of(values)["parse"]["objects"][0]

    np.testing.assert_allclose(mug["middle_m"], [0.1, 0.05, 0.62])
    np.testing.assert_allclose(mug["middle_std_m"], 1e-3 * np.sqrt(3))
    np.testing.assert_allclose(mug["position_std_m"], 1e-3 * np.sqrt(3))


def test_numbers_of_copies_are_told_where_some_were_asked_for(parsed_run: RunValues) -> None:
    """Two mugs: one entry, with as many numbers as can be; none where every shape was asked for once."""
    assert parsed_run.scene is not None
    assert parsed_run.surfaces is not None
    (name, surface), *_ = parsed_run.surfaces.by_name.items()
    surfaces = Surfaces(dict.fromkeys(("mug", "box", "mug_2"), surface))
    shares = np.array([[0.1, 0.7, 0.2, 0.0], [0.02, 0.98, 0.0, 0.0], [0.1, 0.7, 0.2, 0.0]])
    scene = replace(parsed_run.scene, names=np.array(["mug", "box", "mug_2"]), number_probabilities=shares)
    told = summary_of(replace(parsed_run, scene=scene, surfaces=surfaces))["parse"]["counts"]
    assert told == [{"name": name, "probabilities": [0.1, 0.7, 0.2]}]
    assert _count_line(told[0]) == "mug, so many of 2: 0 (0.10), 1 (0.70), 2 (0.20)"
    assert summary_of(parsed_run)["parse"]["counts"] == []


def test_every_requested_shape_is_told_of() -> None:
    """Where it may be if that is likely enough; else its name, of many the first ones and how many more."""
    hidden = {"name": "mug", "presence": 0.2, "presence_std": 0.01, "in_sight": 0.1, "regions": []}
    absent = [{"name": f"box {number}", "presence": 0.01} for number in range(8)]

    assert _not_found_lines([]) == []
    assert _not_found_lines([hidden]) == ["mug: not found, presence 0.200 +- 0.010, 0.10 of it in sight"]
    assert _not_found_lines([absent[0], hidden, absent[1]])[1:] == [
        "not found, presence under 0.05: box 0, box 1"
    ]
    (line,) = _not_found_lines(absent)
    assert line.endswith("box 5 and 2 more")
