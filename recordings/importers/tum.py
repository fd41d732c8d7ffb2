"""The TUM RGB-D benchmark's format: depth.txt, rgb.txt and groundtruth.txt list stamps and what was there.

Depth is registered to colour, in units of 1/5000 m; poses are those of the camera, quaternions xyzw.
"""

from __future__ import annotations

import re
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recordings.errors import RecordingError
from recordings.images.pairing import NearestInTime
from recordings.importers.dataset import ALL_FRAMES, Dataset, ImageFiles, Intrinsics, existing_folder
from recordings.messages.types import UndecodableMessage, rigid_matrix
from recordings.settings import TEXT

_DEPTH_UNIT_M = 1 / 5000
_KINECTS: dict[str, Intrinsics] = {
    "1": (517.3, 516.5, 318.6, 255.3),
    "2": (520.9, 521.0, 325.1, 249.7),
    "3": (535.4, 539.2, 320.1, 247.6),
}
"""The benchmark's calibrations of its three cameras, which its folder names tell."""
_LATEST_S = 1 << 31
_ROS_DEFAULT: Intrinsics = (525.0, 525.0, 319.5, 239.5)


def read_tum(folder: Path, wanted: slice = ALL_FRAMES) -> Dataset:
    """The sequence in a folder; each depth image gets the nearest colour image within 20 ms.

    Raises:
        RecordingError: depth.txt is missing or a list is malformed.
    """
    depth = _listed(existing_folder(folder) / "depth.txt")
    if not depth:
        raise RecordingError(f"{folder / 'depth.txt'} lists no images")
    colour_list = folder / "rgb.txt"
    colour = NearestInTime(iter(_listed(colour_list) if colour_list.exists() else []))
    truth = folder / "groundtruth.txt"
    intrinsics, assumed = _intrinsics(folder)
    frames = []
    for time_ns, words in depth[wanted]:
        nearest = colour.at(time_ns)
        frames.append(ImageFiles(time_ns, folder / words[0], folder / nearest[0] if nearest else None))
    return Dataset(
        frames=frames,
        intrinsics=intrinsics,
        depth_unit_m=_DEPTH_UNIT_M,
        poses=[(time_ns, _pose(truth, words)) for time_ns, words in _listed(truth)] if truth.exists() else [],
        assumed_intrinsics=assumed,
    )


def _intrinsics(folder: Path) -> tuple[Intrinsics, tuple[str, ...]]:
    camera = re.search(r"freiburg([123])", folder.resolve().name)
    if camera:
        return _KINECTS[camera[1]], ()
    return _ROS_DEFAULT, (f"{folder} does not say its camera: taking 525,525,319.5,239.5, right for 640x480",)


def _listed(path: Path) -> list[tuple[int, list[str]]]:
    """Stamp and further words of each line of a list, by increasing stamp; # starts a comment."""
    entries: dict[int, list[str]] = {}
    try:
        lines = path.read_text(encoding=TEXT).splitlines()
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path} is not text") from error
    for number, line in enumerate(lines, 1):
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            seconds = Decimal(words[0])  # a float has too few digits
        except InvalidOperation as error:
            raise RecordingError(f"{path}, line {number}: {words[0]!r} is no time") from error
        if not (seconds.is_finite() and 0 <= seconds < _LATEST_S):
            raise RecordingError(f"{path}, line {number}: {words[0]} is no time in seconds")
        time_ns = round(seconds * 1_000_000_000)
        if len(words) < 2:
            raise RecordingError(f"{path}, line {number} lacks what follows the time")
        entries[time_ns] = words[1:]
    return sorted(entries.items())


def _pose(path: Path, words: list[str]) -> NDArray[np.float64]:
    try:
        x, y, z, qx, qy, qz, qw = map(float, words)
        return rigid_matrix((x, y, z), (qx, qy, qz, qw))
    except (ValueError, UndecodableMessage) as error:
        raise RecordingError(f"{path}: {' '.join(words)!r} is no pose tx ty tz qx qy qz qw") from error
