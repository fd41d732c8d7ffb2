"""The stage `parse`: which objects stand where in the recording, and what rests on what."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.run_folder import Committed
from pipeline.session import Session
from pipeline.stages.colour_input import check_colours, coloured
from pipeline.stages.room import view_stage
from pipeline.stages.sensor import sensor_stage
from pipeline.stages.slam import slam_stage
from pipeline.surfaces import Surfaces
from recordings.types import DepthNoise, Frame
from scene.config import ParseConfig

if TYPE_CHECKING:
    import jax

    from pipeline.meshes import Units
    from recordings.reading import McapRecording
    from recordings.sensor_profile import SensorProfile
    from scene.execution import Progress
    from scene.objects.scene_object import SceneObject
    from scene.result import SceneResult
    from slam.result import SlamResult

SOURCES = (
    "pipeline.stages.parse",
    "pipeline.stages.parse_colour",
    "pipeline.stages.colour_input",
    "pipeline.simplification",
    "scene.parsing",
    "scene.colour_parsing",
)
SURFACE_SOURCES = ("pipeline.shape_folder", "pipeline.meshes", "pipeline.surfaces", "pipeline.bop_numbers")

LEAST_NEAR_SHARE = 0.5
"""Share of a frame's returns near enough to look for objects; of less a warning is given. Chosen by hand."""
SHAPE_DRAWS = 16
"""Draws of a learned shape among which the likelihood's estimates choose."""


def parse_stage(
    session: Session,
    shapes: Path,
    units: Units | None = None,
    options: Mapping[str, Any] | None = None,
    ids: Mapping[str, int] | None = None,
) -> Committed[SceneResult]:
    """The scene in the session's recording.

    Args:
        session: the recording and the run folder.
        shapes: folder of learned shapes or meshes.
        units: of meshes.
        options: what the command's own options say, by key of `ParseConfig`.
        ids: of objects in poses.csv, by name; over those of the models and of the recording.

    Raises:
        PipelineError: a shape or frame is missing, the first frame shows nothing, or the run holds a stage of
            other frames.
    """
    config = session.common.settings.section("parse", ParseConfig, options)
    alone = config.colour == "only"
    _check_frames(session.recording, config)
    needs_path = len(config.frames) > 1 and not alone
    session.begin("parse", *(() if alone else ("sensor",)), *(("slam",) if needs_path else ()))
    surfaces = _surfaces(session, shapes, units, config.objects, ids or {}, config.most if alone else 1)
    if missing := sorted(set(config.exact) - set(surfaces.value.by_name)):
        raise PipelineError(
            f"--exact {missing[0]}: no such shape; there are {', '.join(surfaces.value.by_name)}"
        )
    trajectory = slam_stage(session) if needs_path else None
    sensor = None if alone else sensor_stage(session)

    def compute() -> SceneResult:
        if alone:
            from pipeline.stages.parse_colour import parse_colour_frame

            once = dict(list(surfaces.value.by_name.items())[:: config.most])
            return parse_colour_frame(session, once, config)
        poses = np.eye(4)[None]
        if trajectory is not None:
            poses = relative_poses(trajectory.value, config.frames)
        assert sensor is not None
        return _parse(session, shapes, surfaces.value, poses, sensor.value.profile, config)

    uses = [surfaces, *(one for one in (trajectory, sensor) if one is not None)]
    scene = session.stage("parse", _load, compute, {"parse": config}, uses=uses, sources=SOURCES)
    if session.run.record("slam") is None:
        view_stage(session, scene)
    return scene


def _check_frames(recording: McapRecording, config: ParseConfig) -> None:
    """Refuse frames that cannot be parsed or are not there, before anything is computed or decoded."""
    if config.colour == "only" and len(config.frames) > 1:
        raise PipelineError("--colour only reads one frame; name one with --frames N")
    last = max(config.frames, default=-1)
    count = sum(1 for _ in itertools.islice(recording.stamps_ns(), last + 1))
    if count <= last:
        raise PipelineError(f"{recording.decoded.bag.path} has no frame {last}: it has {count}, from 0 on")


def _load(path: Path) -> SceneResult:
    from scene.result import SceneResult

    return SceneResult.load(path)


def _parse(
    session: Session,
    shapes: Path,
    surfaces: Surfaces,
    poses: NDArray[np.float64],
    sensor: SensorProfile,
    config: ParseConfig,
) -> SceneResult:
    keys = session.key("parse"), session.key("draws")
    with session.common.progress("parse", "blocks") as progress:
        progress.phase("reading")
        session.look()
        progress.phase("preparing shapes")
        try:
            return parse_recording(
                keys, session.recording, shapes, surfaces, poses, sensor, config, session.warn, progress
            )
        except ValueError as error:
            raise PipelineError(f"{session.source.path}: {error}") from error


def parse_recording(
    keys: tuple[jax.Array, jax.Array],
    recording: McapRecording,
    shapes: Path,
    surfaces: Surfaces,
    poses: NDArray[np.float64],
    sensor: SensorProfile,
    config: ParseConfig,
    warn: Callable[[str], None],
    progress: Progress | None = None,
) -> SceneResult:
    """The scene that depth frames of a recording show.

    Args:
        keys: of the parse and of the shapes' draws.
        recording: the frames.
        shapes: folder of learned shapes or meshes.
        surfaces: of what is looked for, from there.
        poses: (F, 4, 4) of the frames' cameras in that of the first of them.
        sensor: what is known of it.
        config: settings.
        warn: called with a sentence for the user.
        progress: told of phases, and of blocks of moves done and in all.

    Raises:
        PipelineError: a frame is missing, or has no colours where they are compared.
        ValueError: the frames show nothing to parse.
    """
    from pipeline.shape_folder import holds_learned_shapes
    from scene.parsing import parse_scene

    key, draw_key = keys
    config = replace(config, unknown_solids=config.unknown_solids and not holds_learned_shapes(shapes))
    numbered = frames_to_parse(recording, config.frames)
    _warn_of_far_frames(numbered, warn)
    if config.adds_colour:
        check_colours(recording, numbered, surfaces.by_name, warn)
    objects = _objects(surfaces, drawn_shapes(shapes, surfaces, draw_key, config))
    if config.adds_colour:
        objects = coloured(objects, surfaces.by_name, config)
    numbers, frames = zip(*numbered, strict=True)
    return parse_scene(
        key,
        frames,
        numbers,
        poses,
        recording.intrinsics,
        sensor.noise or DepthNoise(),
        objects,
        config,
        progress,
        unknown=sensor.unknown,
    )


def _warn_of_far_frames(numbered: Sequence[tuple[int, Frame]], warn: Callable[[str], None]) -> None:
    """Of a frame most of which lies beyond where objects are looked for: what is there counts as absent."""
    from scene.observation.segmentation import FARTHEST_M, near_share

    for number, frame in numbered:
        if (share := near_share(frame.depth_m)) < LEAST_NEAR_SHARE:
            warn(
                f"only {share:.0%} of what frame {number} shows lies within {FARTHEST_M:g} m of the camera, "
                "where objects are looked for: film them from nearer"
            )
            return


def _objects(
    surfaces: Surfaces, draws: Sequence[Sequence[tuple[NDArray[np.float64], NDArray[np.int64]]]]
) -> list[SceneObject]:
    """What is looked for, with the draws of each: half a second to a second of one core an object."""
    from scene.execution import map_parallel
    from scene.objects.scene_object import scene_object

    def prepared(name: str) -> SceneObject:
        surface = surfaces.by_name[name]
        return scene_object(name, surface.vertices_m, surface.faces, drawn[name])

    drawn = dict(zip(surfaces.by_name, draws, strict=True))
    return map_parallel(prepared, surfaces.by_name)


def _surfaces(
    session: Session,
    shapes: Path,
    units: Units | None,
    names: tuple[str, ...],
    ids: Mapping[str, int],
    copies: int,
) -> Committed[Surfaces]:
    """What is looked for, kept in the run as the stage `objects`.

    Every shape of the folder is numbered, asked for or not, so that ids do not depend on the question;
    copies have the id of their shape.
    """
    from pipeline.shape_folder import surface_hashes

    inputs = {f"shapes/{name}": digest for name, digest in surface_hashes(shapes).items()}
    inputs |= {"names": ",".join(names), "units": units or "", "ids": repr(sorted(ids.items()))}
    if copies > 1:
        inputs["copies"] = str(copies)

    def compute() -> Surfaces:
        from pipeline.bop_numbers import ids_of_models, ids_of_names, numbered
        from pipeline.shape_folder import chosen, load_surfaces
        from recordings.dataset_numbers import recorded_dataset_numbers
        from scene.copies import shape_of

        surfaces = load_surfaces(shapes, units)
        recorded = recorded_dataset_numbers(session.source.path)
        known = (ids, ids_of_models(shapes), ids_of_names(surfaces), recorded.object_ids)
        numbers, each = numbered(surfaces, *known), chosen(surfaces, names, copies)
        own = {name: numbers[shape_of(name, surfaces)] for name in each}
        return Surfaces(each, replace(recorded, object_ids=own))

    return session.stage("objects", Surfaces.load, compute, {}, inputs, sources=SURFACE_SOURCES)


def drawn_shapes(
    folder: Path, surfaces: Surfaces, key: jax.Array, config: ParseConfig
) -> list[list[tuple[NDArray[np.float64], NDArray[np.int64]]]]:
    """Vertices and faces of random draws of every shape, none where shapes count as certain."""
    if not config.shape_samples:
        return [[] for _ in surfaces.by_name]
    import jax

    from pipeline.shape_folder import drawn_surfaces, shape_names
    from scene.copies import shape_of

    keys, known = jax.random.split(key, len(surfaces.by_name)), shape_names(folder)
    drawn = [
        drawn_surfaces(folder, shape_of(name, known), key, SHAPE_DRAWS)
        for name, key in zip(surfaces.by_name, keys, strict=True)
    ]
    return [[(one.vertices_m, one.faces) for one in draws] for draws in drawn]


def frames_to_parse(recording: McapRecording, numbers: tuple[int, ...]) -> list[tuple[int, Frame]]:
    """The depth frames of these numbers, or the first that shows enough.

    Raises:
        PipelineError: none shows enough, or the recording ends before the last of them.
    """
    from scene.observation.segmentation import shows_enough

    path = recording.decoded.bag.path
    numbered = enumerate(recording)
    if not numbers:
        shown = next((one for one in numbered if shows_enough(one[1].depth_m)), None)
        if shown is None:
            raise PipelineError(f"{path} has no depth frame that shows enough to parse")
        return [shown]
    wanted = set(numbers)
    frames = [one for one in itertools.islice(numbered, max(numbers) + 1) if one[0] in wanted]
    if len(frames) < len(numbers):
        raise PipelineError(f"{path} has no depth frame {max(numbers)}")
    return frames


def relative_poses(trajectory: SlamResult, numbers: Sequence[int]) -> NDArray[np.float64]:
    """Poses (F, 4, 4) of the frames' cameras in that of the first of them.

    Raises:
        PipelineError: a frame is missing, or is lost.
    """
    for number in numbers:
        if number >= len(trajectory):
            raise PipelineError(f"there is no frame {number}; the recording has {len(trajectory)}")
        if trajectory.lost[number]:
            raise PipelineError(f"slam lost frame {number}: choose others with --frames")
    poses = trajectory.mean[list(numbers)]
    return np.linalg.inv(poses[0]) @ poses
