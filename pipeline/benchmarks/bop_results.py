"""Results files of the BOP challenge: scene_id,im_id,obj_id,score,R,t,time with t in millimetres.

https://bop.felk.cvut.cz/challenges/bop-challenge-2019/ (section "How to participate")
"""

from __future__ import annotations

import csv
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.atomic import write_text
from pipeline.benchmarks.pose_images import ImageKey
from pipeline.benchmarks.pose_rows import Judged
from pipeline.errors import PipelineError
from pipeline.publishing.bop_poses import HEADER, bop_line

COLUMNS = tuple(HEADER.split(","))
NEAREST_MM = 20.0
"""No camera sees anything nearer: smaller distances are metres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BopEstimate:
    """One line of a results file.

    Attributes:
        scene_id: of the image.
        im_id: likewise.
        obj_id: of the model.
        score: of the estimate, larger is surer.
        camera_from_model: (4, 4) in metres.
        seconds: for the whole image; negative where unknown.
    """

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    camera_from_model: NDArray[np.float64]
    seconds: float


def estimates_of(path: Path, scene_id: int, im_id: int) -> list[BopEstimate]:
    """What a file says of one image."""
    return _by_image(path).get((scene_id, im_id), [])


def check_results(path: Path, obj_ids: Collection[int], images: Collection[tuple[int, int]]) -> None:
    """Look through a file before the long work.

    Raises:
        PipelineError: it cannot be read, names unknown objects, holds metres, or none of the images.
    """
    by_image = _by_image(path)
    estimates = [one for found in by_image.values() for one in found]
    unknown = sorted({one.obj_id for one in estimates} - set(obj_ids))
    if unknown:
        known = ", ".join(map(str, sorted(obj_ids)))
        raise PipelineError(f"{path}: there is no object {unknown[0]}; the models have the ids {known}")
    distances = [float(np.linalg.norm(one.camera_from_model[:3, 3])) for one in estimates]
    if distances and 1000 * float(np.median(distances)) < NEAREST_MM:
        raise PipelineError(f"{path}: its translations look like metres; BOP's are millimetres")
    if not set(by_image) & set(images):
        raise PipelineError(f"{path} says nothing of the images that are judged: other scene_id or im_id?")


def write_results(
    path: Path, judged: Iterable[Judged], ids: Mapping[str, int], seconds: Mapping[ImageKey, float]
) -> None:
    """What one method found in all images, as others score it.

    Args:
        path: of the file.
        judged: rows of that method.
        ids: of the models, by shape.
        seconds: of each image.

    Raises:
        PipelineError: the file cannot be written.
    """
    lines = [HEADER]
    for one in judged:
        pose = one.camera_from_object
        if pose is not None:
            numbers = one.scene_id, one.im_id, ids[one.shape]
            lines.append(bop_line(numbers, 1.0 if one.score is None else one.score, pose, seconds[one.image]))
    write_text(path, "\n".join(lines) + "\n")


@lru_cache(maxsize=8)
def _by_image(path: Path) -> dict[tuple[int, int], list[BopEstimate]]:
    """Every estimate by scene and image.

    Raises:
        PipelineError: the file cannot be read; the message names the line.
    """
    found: dict[tuple[int, int], list[BopEstimate]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for number, row in enumerate(csv.reader(file), start=1):
                if not row or (number == 1 and row[0].strip() == COLUMNS[0]):
                    continue
                one = _estimate(path, number, row)
                found.setdefault((one.scene_id, one.im_id), []).append(one)
    except (OSError, UnicodeDecodeError) as error:
        raise PipelineError(f"cannot read {path}: {error}") from error
    return found


def _estimate(path: Path, number: int, row: list[str]) -> BopEstimate:
    try:
        scene_id, im_id, obj_id, score, rotation, translation, seconds = row
        pose = np.eye(4)
        pose[:3, :3] = np.array(rotation.split(), np.float64).reshape(3, 3)
        pose[:3, 3] = np.array(translation.split(), np.float64).reshape(3) / 1000
        if not np.isfinite(pose).all():
            raise ValueError("numbers that are not finite")
        return BopEstimate(
            scene_id=int(scene_id),
            im_id=int(im_id),
            obj_id=int(obj_id),
            score=float(score),
            camera_from_model=pose,
            seconds=float(seconds),
        )
    except ValueError as error:
        raise PipelineError(f"{path}, line {number}: not {','.join(COLUMNS)} ({error})") from error
