"""What summary.json says of a parsed scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

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
