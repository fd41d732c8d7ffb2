"""7-Scenes and its look-alikes (tsdf-fusion, 3DMatch): frame-NNNNNN.depth.png with .pose.txt beside.

Depth is in millimetres with 0 or 65535 for no return, poses are camera-to-world in metres and
orthonormal to three digits only, colour is not registered to the depth and is left out.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recordings.errors import RecordingError
from recordings.importers.dataset import (
    ALL_FRAMES,
    Dataset,
    ImageFiles,
    Intrinsics,
    existing_folder,
    read_numbers,
    stamp_ns,
)
from recordings.poses.rigid import orthonormalised

_DEPTH_NAME = re.compile(r"frame-(\d+)\.depth\.png")
_INTRINSICS_NAMES = ("camera-intrinsics.txt", "intrinsics.K.txt")
_KINECT: Intrinsics = (585.0, 585.0, 320.0, 240.0)


def read_seven_scenes(folder: Path, wanted: slice = ALL_FRAMES) -> Dataset:
    """The sequence in a folder; frames keep their numbers as time, 30 to a second.

    Raises:
        RecordingError: there are no such frames, or a text file is malformed.
    """
    numbered = sorted(
        (int(match[1]), path)
        for path in existing_folder(folder).iterdir()
        if (match := _DEPTH_NAME.fullmatch(path.name))
    )
    if not numbered:
        raise RecordingError(f"{folder} has no frame-NNNNNN.depth.png")
    numbered = numbered[wanted]
    poses = [(stamp_ns(number), _pose(path)) for number, path in numbered]
    intrinsics, assumed = _intrinsics(folder)
    return Dataset(
        frames=[ImageFiles(stamp_ns(number), path) for number, path in numbered],
        intrinsics=intrinsics,
        depth_unit_m=0.001,
        poses=[(time_ns, pose) for time_ns, pose in poses if pose is not None],
        assumed_intrinsics=assumed,
    )


def _intrinsics(folder: Path) -> tuple[Intrinsics, tuple[str, ...]]:
    for name in _INTRINSICS_NAMES:
        if (folder / name).exists():
            matrix = read_numbers(folder / name, (3, 3))
            return (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]), ()
    missing = " or ".join(_INTRINSICS_NAMES)
    return _KINECT, (f"{folder} has no {missing}: taking 7-Scenes' 585,585,320,240, right for 640x480",)


def _pose(depth: Path) -> NDArray[np.float64] | None:
    """The pose beside a depth image; None where tracking was lost or the file is missing."""
    path = depth.with_name(depth.name.replace(".depth.png", ".pose.txt"))
    if not path.exists():
        return None
    matrix = read_numbers(path, (4, 4))
    try:
        return orthonormalised(matrix)
    except ValueError:
        return None
