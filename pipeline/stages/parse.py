"""The stage `parse`: which objects stand where in the recording, and what rests on what."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from pipeline.bop_numbers import ids_of_models, ids_of_names, numbered
from pipeline.errors import PipelineError
from pipeline.meshes import Units
from pipeline.session import Session
from pipeline.shape_folder import chosen, drawn_surfaces, load_surfaces, surface_hashes
from pipeline.stages.room import view_stage
from pipeline.stages.slam import slam_stage
from pipeline.surfaces import Surfaces
from recordings.dataset_numbers import recorded_dataset_numbers
from recordings.types import DepthNoise, Frame
from scene.config import ParseConfig
from scene.objects.scene_object import scene_object
from scene.observation.segmentation import shows_enough
from scene.parsing import parse_scene
from scene.result import SceneResult

SHAPE_DRAWS = 16
"""Draws of a learned shape among which the likelihood's estimates choose."""


def parse_stage(
    session: Session,
    shapes: Path,
    units: Units | None = None,
    options: Mapping[str, Any] | None = None,
    ids: Mapping[str, int] | None = None,
) -> SceneResult:
    """The scene in the session's recording.

    Args:
        session: the recording and the run folder.
        shapes: folder of learned shapes or meshes.
        units: of meshes.
        options: what the command's own options say, by key of `ParseConfig`.
        ids: of objects in poses.csv, by name; over those of the models and of the recording.

    Raises:
        PipelineError: a shape or frame is missing, or the first frame shows nothing.
    """
    config = session.common.settings.section("parse", ParseConfig, options)
    surfaces = _surfaces(session, shapes, units, config.objects, ids or {})
    inputs = {"objects": session.run.fingerprint("objects")}
    poses = np.eye(4)[None]
    if len(config.frames) > 1:
        trajectory = slam_stage(session)
        inputs["slam"] = session.run.fingerprint("slam")
        poses = _relative_poses(trajectory.mean, config.frames)

    def compute() -> SceneResult:
        key, draw_key = session.key("parse"), session.key("draws")
        objects = [
            scene_object(name, one.vertices_m, one.faces, draws)
            for (name, one), draws in zip(
                surfaces.by_name.items(), _draws(shapes, surfaces, draw_key, config), strict=True
            )
        ]
        with session.common.progress("parse", "blocks") as progress:
            try:
                numbers, frames = zip(*_frames(session, config.frames), strict=True)
                return parse_scene(
                    key,
                    frames,
                    numbers,
                    poses,
                    session.recording.intrinsics,
                    DepthNoise(),
                    objects,
                    config,
                    progress,
                )
            except ValueError as error:
                raise PipelineError(f"{session.source.path}: {error}") from error

    scene = session.stage("parse", SceneResult.load, compute, {"parse": config}, inputs)
    if session.run.record("slam") is None:
        view_stage(session, int(scene.frames[0]))
    return scene


def _surfaces(
    session: Session,
    shapes: Path,
    units: Units | None,
    names: tuple[str, ...],
    ids: Mapping[str, int],
) -> Surfaces:
    """What is looked for, kept in the run as the stage `objects`.

    Every shape of the folder is numbered, asked for or not, so that ids do not depend on the question.
    """
    inputs = {f"shapes/{name}": digest for name, digest in surface_hashes(shapes).items()}
    inputs |= {"names": ",".join(names), "units": units or "", "ids": repr(sorted(ids.items()))}

    def compute() -> Surfaces:
        surfaces = load_surfaces(shapes, units)
        recorded = recorded_dataset_numbers(session.source.path)
        known = (ids, ids_of_models(shapes), ids_of_names(surfaces), recorded.object_ids)
        return Surfaces(chosen(surfaces, names), replace(recorded, object_ids=numbered(surfaces, *known)))

    return session.stage("objects", Surfaces.load, compute, {}, inputs)


def _draws(
    folder: Path, surfaces: Surfaces, key: jax.Array, config: ParseConfig
) -> list[list[tuple[NDArray[np.float64], NDArray[np.int64]]]]:
    """Vertices and faces of random draws of every shape, none where shapes count as certain."""
    if not config.shape_samples:
        return [[] for _ in surfaces.by_name]
    keys = jax.random.split(key, len(surfaces.by_name))
    drawn = [
        drawn_surfaces(folder, name, key, SHAPE_DRAWS)
        for name, key in zip(surfaces.by_name, keys, strict=True)
    ]
    return [[(one.vertices_m, one.faces) for one in draws] for draws in drawn]


def _frames(session: Session, numbers: tuple[int, ...]) -> list[tuple[int, Frame]]:
    """The depth frames of these numbers, or the first that shows enough.

    Raises:
        PipelineError: the recording ends before the last of them.
    """
    numbered = enumerate(session.recording)
    if not numbers:
        shown = next((one for one in numbered if shows_enough(one[1].depth_m)), None)
        if shown is None:
            raise PipelineError(f"{session.source.path} has no depth frame that shows enough to parse")
        return [shown]
    wanted = set(numbers)
    frames = [one for one in itertools.islice(numbered, max(numbers) + 1) if one[0] in wanted]
    if len(frames) < len(numbers):
        raise PipelineError(f"{session.source.path} has no depth frame {max(numbers)}")
    return frames


def _relative_poses(
    reference_from_camera: NDArray[np.float64], numbers: tuple[int, ...]
) -> NDArray[np.float64]:
    """Poses (F, 4, 4) of the frames' cameras in that of the first of them."""
    if max(numbers) >= len(reference_from_camera):
        raise PipelineError(
            f"there is no frame {max(numbers)}; the recording has {len(reference_from_camera)}"
        )
    poses = reference_from_camera[list(numbers)]
    return np.linalg.inv(poses[0]) @ poses
