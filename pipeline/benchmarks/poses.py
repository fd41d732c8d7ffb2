"""Poses of known objects, judged image by image: ours, ours without a graph (3DP3*), peers, other programs.

A task is one image with the methods that have not been tried on it; whatever is random in it comes from its
numbers, so that rows do not depend on where and in which order images are judged.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.benchmarks.pose_images import ImageKey, PoseImage
from pipeline.benchmarks.pose_methods import Estimated, Method, Registration, registration_error_m
from pipeline.benchmarks.pose_rows import Judged, KeptRows
from pipeline.benchmarks.pose_sources import PoseSource, Tables
from pipeline.errors import PipelineError
from pipeline.evaluation.object_poses import MISSING_M
from pipeline.evaluation.scenes import ObjectError, object_errors
from pipeline.fingerprints import COMPUTES, source_hash
from pipeline.jax_setup import set_up_jax
from pipeline.mesh_source import MeshSource
from pipeline.progress import Report
from pipeline.quiet_stdout import stdout_to_stderr
from pipeline.task_engine import Executors, Task, run_tasks
from recordings.truth import TABLE

TUNING_SEED, TUNING_TABLES = 900_000, 1
TUNING_OBJECTS = 3
"""On each tuning table, on which the settings of peers are tried."""
MOST_ERROR_M = 0.1
"""Larger errors count as this when settings are compared."""
ESTIMATE_AFTER = 8
"""Images after which the remaining time is told."""

Found = list[tuple[str, list[Judged], float]]
"""Method, rows and seconds."""


def judged_images(
    source: PoseSource,
    methods: Sequence[Method],
    executors: Executors,
    at_once: int,
    folder: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[tuple[ImageKey, Found]]:
    """Rows of every image, those that were kept before first.

    The first image of each kind is judged before the others start: it compiles for all.

    Args:
        source: of the images.
        methods: the columns.
        executors: where images are judged.
        at_once: so many of them.
        folder: rows found there are taken from it, and new ones are kept there.
        progress: is told images done and in all.

    Raises:
        PipelineError: an image cannot be made or judged; the rows of others are kept.
    """
    before = dict(kept_images(source, methods, folder))
    yield from ((key, found) for key, found in before.items() if len(found) == len(methods))
    missing = {
        key: tuple(one for one in methods if one.title not in {title for title, *_ in before.get(key, [])})
        for key in source.places()
    }
    missing = {key: untried for key, untried in missing.items() if untried}
    done, total = len(source.places()) - len(missing), len(source.places())
    if progress:
        progress(done, total)
    first = list({key.kind: key for key in reversed(missing)}.values())[::-1]
    for batch, limit in ((first, 1), ([key for key in missing if key not in first], at_once)):
        tasks = {
            str(key): Task(name=str(key), call=judge_image, arguments=(source, key, missing[key]))
            for key in batch
        }
        keys = {str(key): key for key in batch}
        for outcome in run_tasks(list(tasks.values()), executors, limit):
            if outcome.error is not None or outcome.result is None:
                raise PipelineError(f"image {outcome.task.name}: {outcome.error}") from outcome.error
            key, found = keys[outcome.task.name], outcome.result
            _keep(folder, source, missing[key], key, found)
            done += 1
            if progress:
                progress(done, total)
            yield key, [*before.get(key, []), *found]


def kept_images(
    source: PoseSource, methods: Sequence[Method], folder: Path | None
) -> Iterator[tuple[ImageKey, Found]]:
    """What a folder holds of every image, without judging any."""
    kept = {method.title: KeptRows(folder, _about(source, method)) for method in methods}
    for key in source.places():
        rows = [(title, one.find(key, title)) for title, one in kept.items()]
        found = [(title, *one) for title, one in rows if one is not None]
        if found:
            yield key, found


def _keep(
    folder: Path | None, source: PoseSource, methods: Sequence[Method], key: ImageKey, found: Found
) -> None:
    for method, (title, rows, seconds) in zip(methods, found, strict=True):
        KeptRows(folder, _about(source, method)).keep(key, title, rows, seconds)


def collected(
    images: Iterable[tuple[ImageKey, Found]],
) -> tuple[list[Judged], dict[str, dict[ImageKey, float]]]:
    """All rows in the order of the images, and the seconds of each method on each image."""
    judged, seconds = list[Judged](), dict[str, dict[ImageKey, float]]()
    for key, found in images:
        for title, rows, spent in found:
            judged += rows
            seconds.setdefault(title, {})[key] = spent
    return sorted(judged, key=lambda one: (one.scene_id, one.im_id, one.kind, one.name)), seconds


def judge_image(source: PoseSource, key: ImageKey, methods: Sequence[Method]) -> Found:
    """What each method makes of one image; a worker sets JAX up for it."""
    set_up_jax()
    with stdout_to_stderr():
        image = source.image(key)
        found = []
        for method in methods:
            estimated = method.estimate(image, source.shapes)
            found.append((method.title, judgements(image, method, estimated), estimated.seconds))
    return found


def judgements(image: PoseImage, method: Method, estimated: Estimated) -> list[Judged]:
    """The rows of an image's objects."""
    errors: dict[str, ObjectError] = {
        one.name: one
        for one in object_errors(image.objects, image.meshes, image.camera_from_world, estimated.poses)
    }
    return [
        Judged(
            method=method.title,
            setting=method.setting,
            kind=image.key.kind,
            scene_id=image.key.scene_id,
            im_id=image.key.im_id,
            name=one.name,
            shape=one.shape,
            error_m=errors[one.name].add_s_m,
            visible_fraction=one.visible_fraction,
            stacked=one.parent not in {TABLE, None},
            flush=one.contact_faces is not None,
            parent_right=estimated.parents_right.get(one.name),
            there=True,
            score=estimated.scores.get(one.shape),
            level=estimated.levels.get(one.shape),
            estimate=_rows_of(errors[one.name].estimate),
        )
        for one in image.objects
    ] + [_absent(image, method, estimated, shape) for shape in image.absent if shape in estimated.scores]


def _absent(image: PoseImage, method: Method, estimated: Estimated, shape: str) -> Judged:
    """The row of a shape that was asked for and is not there."""
    poses = [pose for name, pose in estimated.poses if name == shape]
    return Judged(
        method=method.title,
        setting=method.setting,
        kind=image.key.kind,
        scene_id=image.key.scene_id,
        im_id=image.key.im_id,
        name=shape,
        shape=shape,
        error_m=MISSING_M,
        visible_fraction=None,
        stacked=False,
        flush=False,
        parent_right=None,
        there=False,
        score=estimated.scores[shape],
        level=None,
        estimate=_rows_of(poses[0] if poses else None),
    )


def tuned(method: Registration, shapes: MeshSource, choices: Sequence[str]) -> Registration:
    """The peer with its setting of least mean error, 10 cm at most each, on tables of their own."""
    if len(choices) == 1:
        return replace(method, setting=choices[0])
    objects = min(TUNING_OBJECTS, len(shapes.meshes))
    numbers = tuple(range(TUNING_TABLES))
    tables = Tables(shapes=shapes, objects=objects, seed=TUNING_SEED, numbers=numbers)
    images = [tables.image(key) for key in tables.places()]

    def mean_error(setting: str) -> float:
        tried = replace(method, setting=setting)
        errors = [
            min(registration_error_m(tried, image, shapes, index), MOST_ERROR_M)
            for image in images
            for index in range(len(image.objects))
        ]
        return float(np.mean(errors))

    return replace(method, setting=min(choices, key=mean_error))


class RemainingTime:
    """Says once, after some images, how long the rest will take.

    Args:
        say: is given the sentence.
        progress: is told images done and in all as well.
    """

    def __init__(self, say: Callable[[str], None], progress: Report) -> None:
        self._say, self._progress = say, progress
        self._begun: tuple[float, int] | None = None

    def __call__(self, done: int, total: int | None = None) -> None:
        """Images done and in all."""
        self._progress(done, total)
        now = time.monotonic()
        if self._begun is None:
            self._begun = now, done
            return
        begun_s, first = self._begun
        if total is not None and done - first == ESTIMATE_AFTER and total > done:
            seconds = (now - begun_s) / ESTIMATE_AFTER * (total - done)
            self._say(f"{done} of {total} images: about {seconds / 60:.0f} minutes for the rest")


def _about(source: PoseSource, method: Method) -> list[Any]:
    return [source.about(), repr(method), source_hash(__name__, within=COMPUTES)]


def _rows_of(estimate: np.ndarray | None) -> tuple[float, ...] | None:
    return None if estimate is None else tuple(float(value) for value in estimate[:3].ravel())
