"""The truth beside a run: path and objects where they really were, and how often regions hold the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from pipeline.colours import TRUTH
from pipeline.errors import PipelineError
from pipeline.evaluation.object_poses import best_matches
from pipeline.evaluation.scenes import region_level
from pipeline.evaluation.trajectories import compared, levels_of_truth, reference_trajectory
from pipeline.evaluation.truth import RecordedTruth
from pipeline.publishing.values import RunValues
from pipeline.report import charts
from pipeline.surfaces import SceneSurface, Surfaces
from pipeline.views.timelines import time_columns
from recordings.options import ReadOptions
from recordings.truth import recorded_scene_truth
from scene.result import SceneResult
from slam.result import SlamResult

PATH_WIDTH, BOX_WIDTH = rr.Radius.ui_points(2.0), rr.Radius.ui_points(1.5)
_DEFAULT_OPTIONS = ReadOptions()
LEVELS = np.linspace(0, 1, 101)
ERROR_PLOT = "plots/error", "Position error from the first frame, mm"

Placed = tuple[str, NDArray[np.float64]]
"""An object's shape, and where it is (4, 4)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RunTruth:
    """What is true of a run, in its own reference frame.

    Attributes:
        path: (n, 4, 4) true reference_from_camera of the frames that have one; the first is taken as found.
        errors_m: (T,) how far the position found of each frame is from the true one; NaN without.
        objects: of what was looked for shape and true reference_from_object (4, 4), by name of the object.
        levels: level of the region told at whose edge the truth lies, (m,) by what the regions are of.
    """

    path: NDArray[np.float64]
    errors_m: NDArray[np.float64]
    objects: Mapping[str, Placed]
    levels: Mapping[str, NDArray[np.float64]]


def truth_of(values: RunValues, source: Path, options: ReadOptions = _DEFAULT_OPTIONS) -> RunTruth:
    """The truth that a recording or a TUM file holds of a run.

    Args:
        values: of the run.
        source: of the truth.
        options: how a recording is read.

    Raises:
        RecordingError: the file cannot be read.
        PipelineError: it says nothing of this run.
    """
    path, errors_m = np.zeros((0, 4, 4)), np.zeros(0)
    objects: dict[str, Placed] = {}
    levels: dict[str, NDArray[np.float64]] = {}
    if values.slam is not None and len(values.slam) > 1:
        path, errors_m, levels["camera"] = _camera_truth(values.slam, source, options)
    if values.scene is not None and values.surfaces is not None and recorded_scene_truth(source) is not None:
        in_camera = _objects_truth(values.parsed_time_ns, values.surfaces, RecordedTruth(source, options))
        objects = {
            name: (shape, values.reference_from_parsed @ pose) for name, (shape, pose) in in_camera.items()
        }
        found = _object_levels(values.scene, values.surfaces, list(in_camera.values()))
        if len(found):
            levels["objects"] = found
    if not levels and not objects:
        raise PipelineError(f"{source} holds no truth of what this run found or looked for")
    return RunTruth(path=path, errors_m=errors_m, objects=objects, levels=levels)


def _camera_truth(
    slam: SlamResult, source: Path, options: ReadOptions
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    reference = reference_trajectory(source, options)
    frames, poses = compared(slam.times_ns, reference)
    path = slam.mean[frames[0]] @ np.linalg.inv(poses[0]) @ poses
    errors_m = np.full(len(slam), np.nan)
    errors_m[frames] = np.linalg.norm(path[:, :3, 3] - slam.mean[frames, :3, 3], axis=1)
    return path, errors_m, levels_of_truth(slam, reference)


def _objects_truth(time_ns: int | None, surfaces: Surfaces, known: RecordedTruth) -> dict[str, Placed]:
    """Shape and true camera_from_object (4, 4) at a frame's stamp of each object that was looked for."""
    camera_from_world = known.camera_from_world(time_ns)
    return {
        one.name: (one.shape, camera_from_world @ one.world_from_object)
        for one in known.scene.objects
        if one.shape in surfaces.by_name
    }


def _object_levels(scene: SceneResult, surfaces: Surfaces, true: Sequence[Placed]) -> NDArray[np.float64]:
    """Levels (m,) of the normal regions of the objects' middles that the true middles are on the edge of.

    Args:
        scene: as parsed.
        surfaces: of what was looked for.
        true: shapes and camera_from_object of the true objects; those of one shape are matched with what
            was found of it so that their middles are nearest.
    """
    levels = []
    for shape in dict.fromkeys(shape for shape, _ in true):
        middle = _box(surfaces.by_name[shape]).mean(axis=0)
        places = [pose for of, pose in true if of == shape]
        found = [
            one
            for one in np.flatnonzero(scene.found).tolist()
            if surfaces.shape_names[str(scene.names[one])] == shape
        ]
        really_m, told_m = (
            poses[:, :3, :3] @ middle + poses[:, :3, 3]
            for poses in (np.array(places), scene.camera_from_object[found])
        )
        for row, column in best_matches(np.linalg.norm(really_m[:, None] - told_m, axis=-1)):
            levels.append(region_level(scene, found[column], middle, places[row]))
    return np.array(levels)


def calibration_picture(truth: RunTruth) -> bytes:
    """A PNG: the share of truths that lie inside the regions of each level, beside what it should be."""
    series = {"as reported": LEVELS}
    for what, levels in truth.levels.items():
        series[f"{what}, {len(levels)}"] = (levels[None] <= LEVELS[:, None]).mean(axis=1)
    return charts.lines(LEVELS, series, "level of the region", "share of the truth inside")


def log_truth(recording: rr.RecordingStream, values: RunValues, truth: RunTruth) -> None:
    """The true path and the boxes of true objects in the room, the error over time, and the calibration."""
    if values.slam is not None and len(truth.path):
        strip = rr.LineStrips3D([truth.path[:, :3, 3]], colors=TRUTH, radii=PATH_WIDTH)
        recording.log("world/truth/path", strip, static=True)
        entity, name = ERROR_PLOT
        recording.log(entity, rr.SeriesLines(names=name, colors=TRUTH, widths=1.5), static=True)
        columns = rr.Scalars.columns(scalars=1000 * truth.errors_m)
        recording.send_columns(entity, indexes=time_columns(values.slam.times_ns), columns=columns)
    for name, (shape, pose) in truth.objects.items():
        assert values.surfaces is not None  # there are objects
        box = _box(values.surfaces.by_name[shape])
        outline = rr.Boxes3D(
            centers=[box.mean(axis=0)],
            half_sizes=[np.ptp(box, axis=0) / 2],
            colors=TRUTH,
            radii=BOX_WIDTH,
            fill_mode=rr.components.FillMode.MajorWireframe,
        )
        path = f"world/truth/objects/{rr.escape_entity_path_part(name)}"
        recording.log(path, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), static=True)
        recording.log(path, outline, static=True)
    picture = rr.EncodedImage(contents=calibration_picture(truth), media_type="image/png")
    recording.log("calibration", picture, static=True)


def _box(surface: SceneSurface) -> NDArray[np.float64]:
    """Corners (2, 3) of an object's box in its own frame."""
    return np.stack([surface.vertices_m.min(axis=0), surface.vertices_m.max(axis=0)])
