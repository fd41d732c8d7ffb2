"""What `bench poses` found, object by object, and the files that keep it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.atomic import write_json, write_table
from pipeline.benchmarks.pose_images import ImageKey
from pipeline.fingerprints import canonical_hash


@dataclass(frozen=True, kw_only=True)
class Judged:
    """One method's answer about one object.

    Attributes:
        method: its name.
        setting: the one that was chosen for it; empty where there is no choice.
        kind: of image.
        scene_id: of the image.
        im_id: likewise.
        name: of the object, unique in its image.
        shape: of the object.
        error_m: ADD-S.
        visible_fraction: of the object; None where nobody counted.
        stacked: the object rests on another.
        flush: it rests on a face of its bounding box.
        parent_right: where the method tells parents and the truth has one.
        there: whether it is; what is asked for and not there has no error, and is judged by its score.
        score: that the method gives to what it found; our presence.
        level: of the told region of its middle that the true one is on the edge of, where regions are told.
        estimate: camera_from_object by rows (12 numbers); None where the object was not found.
    """

    method: str
    setting: str
    kind: str
    scene_id: int
    im_id: int
    name: str
    shape: str
    error_m: float
    visible_fraction: float | None
    stacked: bool
    flush: bool
    parent_right: bool | None
    there: bool
    score: float | None
    level: float | None
    estimate: tuple[float, ...] | None

    @property
    def image(self) -> ImageKey:
        """Where the object was seen."""
        return ImageKey(self.kind, self.scene_id, self.im_id)

    @property
    def camera_from_object(self) -> np.ndarray | None:
        """The estimate (4, 4)."""
        if self.estimate is None:
            return None
        return np.vstack([np.reshape(self.estimate, (3, 4)), [0.0, 0.0, 0.0, 1.0]])


class KeptRows:
    """Rows in a folder, a small file for each image and method, so that an interrupted bench goes on.

    Seconds stand in files of their own: rows have the same bytes wherever they were made.

    Args:
        folder: made when the first rows are kept; None keeps nothing.
        about: everything that the rows depend on besides image and method; rows of others are passed over.
    """

    def __init__(self, folder: Path | None, about: Any) -> None:
        self._folder = folder
        self._fingerprint = canonical_hash(about)

    def find(self, image: ImageKey, method: str) -> tuple[list[Judged], float] | None:
        """Rows and seconds of a method on an image, if they were kept under the same fingerprint."""
        if self._folder is None:
            return None
        try:
            told = json.loads(self._path(image, method).read_text())
            seconds = json.loads(self._path(image, method, "seconds").read_text())["seconds"]
            if told["fingerprint"] != self._fingerprint:
                return None
            return [_judged(row) for row in told["rows"]], float(seconds)
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def keep(self, image: ImageKey, method: str, rows: Sequence[Judged], seconds: float) -> None:
        """Write them, the rows last.

        Raises:
            PipelineError: the folder cannot be written.
        """
        if self._folder is None:
            return
        self._path(image, method).parent.mkdir(parents=True, exist_ok=True)
        self._path(image, method, "seconds").parent.mkdir(parents=True, exist_ok=True)
        write_json(self._path(image, method, "seconds"), {"seconds": seconds})
        content = {"fingerprint": self._fingerprint, "rows": [asdict(row) for row in rows]}
        write_json(self._path(image, method), content)

    def _path(self, image: ImageKey, method: str, part: str = "rows") -> Path:
        assert self._folder is not None
        name = "".join(letter if letter.isalnum() else "_" for letter in method)
        return self._folder / part / name / f"{image.kind}_{image.scene_id:06d}_{image.im_id:06d}.json"


def write_csv(path: Path, judged: Sequence[Judged]) -> None:
    """All rows as one table.

    Raises:
        PipelineError: the file cannot be written.
    """

    def row(one: Judged) -> dict[str, object]:
        estimate = "" if one.estimate is None else " ".join(f"{value:.9g}" for value in one.estimate)
        return {**asdict(one), "estimate": estimate}

    write_table(path, [field.name for field in fields(Judged)], map(row, judged))


def _judged(row: dict[str, Any]) -> Judged:
    estimate = row["estimate"]
    return Judged(**{**row, "estimate": None if estimate is None else tuple(map(float, estimate))})
