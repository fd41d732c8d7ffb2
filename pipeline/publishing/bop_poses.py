"""Object poses as the BOP challenge reads them."""

from __future__ import annotations

import re

import numpy as np

from scene.result import SceneResult

HEADER = "scene_id,im_id,obj_id,score,R,t,time"
NUMBERED = re.compile(r"(?:obj_)?(\d+)(?:_|$)")
UNKNOWN_TIME = -1
"""Clocks stand in timing.json alone."""


def bop_lines(scene: SceneResult) -> str:
    """One line for each object found: R by rows, t in millimetres; ids are those in the names, else places.

    Names such as 003_cracker_box (YCB) and obj_000003 (BOP) give the object's id.
    """
    lines = [HEADER]
    for one in map(int, np.flatnonzero(scene.found)):
        pose = scene.camera_from_object[one]
        rotation = " ".join(f"{value:.9f}" for value in pose[:3, :3].ravel() + 0.0)
        translation = " ".join(f"{value:.6f}" for value in 1000 * pose[:3, 3] + 0.0)
        score = f"{scene.presence[one]:.6f}"
        fields = (0, scene.frames[0], _object_id(scene, one), score, rotation, translation, UNKNOWN_TIME)
        lines.append(",".join(map(str, fields)))
    return "\n".join(lines) + "\n"


def _object_id(scene: SceneResult, one: int) -> int:
    numbered = NUMBERED.match(str(scene.names[one]))
    return int(numbered[1]) if numbered else one + 1
