"""Redwood and Open3D's example folders: depth/*.png in millimetres, colour beside, trajectory.log.

trajectory.log gives each frame three integers, the first its number, and a camera-to-world matrix.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
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
    stamp_ns,
)
from recordings.poses.rigid import orthonormalised
from recordings.settings import TEXT

_COLOUR_FOLDERS = ("color", "image", "rgb")
_COLOUR_SUFFIXES = {".jpg", ".jpeg", ".png"}
_PRIMESENSE: Intrinsics = (525.0, 525.0, 319.5, 239.5)
_NUMBERS_A_POSE = 3 + 16


def read_redwood(folder: Path, wanted: slice = ALL_FRAMES) -> Dataset:
    """The sequence in a folder; frames are stamped 30 to a second.

    Raises:
        RecordingError: there is no depth folder, or a text file is malformed.
    """
    depth = _in_order(existing_folder(existing_folder(folder) / "depth").glob("*.png"))
    if not depth:
        raise RecordingError(f"{folder / 'depth'} has no PNG images")
    colour = _colour_images(folder)
    if colour and len(colour) != len(depth):
        raise RecordingError(f"{folder} has {len(depth)} depth and {len(colour)} colour images")
    intrinsics, assumed = _intrinsics(folder)
    trajectory = folder / "trajectory.log"
    return Dataset(
        frames=[
            ImageFiles(stamp_ns(number), path, colour[number] if colour else None)
            for number, path in list(enumerate(depth))[wanted]
        ],
        intrinsics=intrinsics,
        depth_unit_m=0.001,
        poses=_poses(trajectory) if trajectory.exists() else (),
        assumed_intrinsics=assumed,
    )


def _colour_images(folder: Path) -> list[Path]:
    for name in _COLOUR_FOLDERS:
        if (folder / name).is_dir():
            return _in_order(p for p in (folder / name).iterdir() if p.suffix.lower() in _COLOUR_SUFFIXES)
    return []


def _in_order(paths: Iterable[Path]) -> list[Path]:
    """Images by the numbers in their names, with leading zeros or without, as Open3D orders them."""

    def key(path: Path) -> list[str | int]:  # words and numbers take turns
        return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)]

    return sorted(paths, key=key)


def _intrinsics(folder: Path) -> tuple[Intrinsics, tuple[str, ...]]:
    """The camera from an Open3D camera file (a column-major matrix in JSON), if the folder has one."""
    for path in sorted(folder.glob("*.json")):
        try:
            content = json.loads(path.read_text(encoding=TEXT))
            matrix = np.array(content["intrinsic_matrix"], np.float64).reshape(3, 3).T
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            continue
        return (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]), ()
    assumed = "taking Redwood's 525,525,319.5,239.5, right for 640x480"
    return _PRIMESENSE, (f"{folder} has no camera file: {assumed}",)


def _poses(path: Path) -> list[tuple[int, NDArray[np.float64]]]:
    try:
        numbers = np.array(path.read_text(encoding=TEXT).split(), np.float64).reshape(-1, _NUMBERS_A_POSE)
        return [(stamp_ns(int(row[0])), orthonormalised(row[3:].reshape(4, 4))) for row in numbers]
    except (OSError, ValueError, OverflowError) as error:
        raise RecordingError(f"{path} is not a trajectory of Redwood: {error}") from error
