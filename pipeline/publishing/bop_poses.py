"""Object poses as the BOP challenge reads them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pipeline.publishing.values import RunValues

HEADER = "scene_id,im_id,obj_id,score,R,t,time"
UNKNOWN_TIME = -1
"""Clocks stand in timing.json alone."""


def bop_lines(
    values: RunValues,
    object_from_model: Mapping[str, NDArray[np.float64]] | None = None,
    ids: Mapping[str, int] | None = None,
) -> str:
    """One line for each object found: R by rows, t in millimetres.

    Scene and image are numbered as the recording's data set does it, else 0 and the number of the frame.

    Args:
        values: of a run with a finished parse.
        object_from_model: (4, 4) by name, where the models are in frames of their own.
        ids: of all objects by name, in place of those of the run.
    """
    scene, surfaces = values.scene, values.surfaces
    assert scene is not None
    assert surfaces is not None
    numbers = surfaces.numbers
    image = numbers.image_ids.get(values.parsed_time_ns or 0, int(scene.frames[0]))
    lines = [HEADER]
    for one in map(int, np.flatnonzero(scene.found)):
        name = str(scene.names[one])
        pose = scene.camera_from_object[one] @ (object_from_model or {}).get(name, np.eye(4))
        number = (ids or surfaces.object_ids)[name]
        lines.append(bop_line((numbers.scene_id, image, number), float(scene.presence[one]), pose))
    return "\n".join(lines) + "\n"


def bop_line(
    numbers: tuple[int, int, int],
    score: float,
    camera_from_model: NDArray[np.float64],
    seconds: float = UNKNOWN_TIME,
) -> str:
    """One line of a results file, for scene, image and object of these numbers; the pose (4, 4) in metres."""
    rotation = " ".join(f"{value:.9f}" for value in camera_from_model[:3, :3].ravel() + 0.0)
    translation = " ".join(f"{value:.6f}" for value in 1000 * camera_from_model[:3, 3] + 0.0)
    return ",".join(map(str, (*numbers, f"{score:.6f}", rotation, translation, seconds)))
