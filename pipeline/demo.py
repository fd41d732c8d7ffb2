"""The whole program on recordings made for it, and how far from the truth it ends.

OUT/recordings/*.mcap      one for each object to learn, and a table with all of them
OUT/recordings/*.json      what each was filmed from, and its hash: it is kept as long as both are the same
OUT/project.toml           the same for `voxscene run`, to begin one's own from; kept where it was changed
OUT/run                    its run folder
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import tomli_w
from numpy.typing import NDArray

from pipeline.atomic import write_json, write_text
from pipeline.config import plain_values
from pipeline.errors import PipelineError
from pipeline.evaluation.scenes import ObjectError, object_errors
from pipeline.evaluation.shapes import shape_agreement
from pipeline.evaluation.trajectories import slam_errors
from pipeline.evaluation.truth import RecordedTruth, true_mesh
from pipeline.fingerprints import PROGRAM, canonical_hash, file_hash, source_hash
from pipeline.logs import log
from pipeline.options import Common
from pipeline.project import Project, ProjectRecording
from pipeline.project_run import recording_folder, run_project
from pipeline.publishing.values import RunValues
from pipeline.run_folder import RunFolder
from pipeline.synthesis.filming import film_object, film_table
from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.paths import PathConfig
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import CameraConfig, ObjectScene, TableScene
from pipeline.synthesis.writing import write_recording

OBJECTS = ("box", "can", "bottle", "bracket", "marker")
"""Walls of the others are thinner than a voxel, so that no grid of voxels comes near them."""
TABLE = "table"
ROUND_THE_OBJECT = PathConfig(
    kind="handheld", frames=60, degrees_per_frame=12.0, radius_m=0.75, elevations_deg=(20.0, 50.0)
)
"""Twice round, from the side upwards."""
ROOM = RoomConfig(kind="cluttered")
CAMERA = CameraConfig(width=640, height=480)
AT_THE_TABLE = PathConfig(
    kind="handheld", frames=5, degrees_per_frame=4.0, radius_m=0.8, elevations_deg=(40.0,)
)
FILMED_BY = ("pipeline.synthesis.filming", "pipeline.synthesis.objects", "pipeline.synthesis.writing")
Scene = TypeVar("Scene", ObjectScene, TableScene)

TRAJECTORY_GATE_CM = 2.0
IOU_GATE = 0.9
NEAR_M = 0.01
NEAR_GATE = 4
"""Objects that must lie nearer than `NEAR_M`."""


@dataclass(frozen=True, kw_only=True)
class LearnedObject:
    """How well one object's recording was used.

    Attributes:
        trajectory_error_cm: root mean square over the frames, from the first pose.
        iou: of the learned shape, its hidden inside included, with the truth, as the bench tells it. Of the
            seen voxels alone, a layer thick, a flat face is right or wrong as a whole where it falls on voxel
            centres.
    """

    trajectory_error_cm: float
    iou: float


@dataclass(frozen=True, kw_only=True)
class DemoResult:
    """What came of it, by name of the object."""

    learned: dict[str, LearnedObject]
    parsed: list[ObjectError]

    @property
    def document(self) -> dict[str, Any]:
        """The fields that other programs rely on: the worst trajectory and the worst shape first."""
        return {
            "trajectory_error_cm": max(one.trajectory_error_cm for one in self.learned.values()),
            "iou": min(one.iou for one in self.learned.values()),
            "under_1cm": sum(one.add_s_m < NEAR_M for one in self.parsed),
            "objects": len(self.parsed),
            "learned": {name: asdict(one) for name, one in self.learned.items()},
            "parsed": [_plain(one) for one in self.parsed],
        }

    @property
    def holds(self) -> bool:
        """True if every gate holds."""
        found = self.document
        return (
            found["trajectory_error_cm"] <= TRAJECTORY_GATE_CM
            and found["iou"] >= IOU_GATE
            and found["under_1cm"] >= NEAR_GATE
        )


def _plain(error: ObjectError) -> dict[str, Any]:
    """The error's fields as JSON has them."""
    return {**asdict(error), "estimate": None if error.estimate is None else error.estimate.tolist()}


def demonstrate(folder: Path, common: Common) -> DemoResult:
    """Film, run and evaluate; what is there from an earlier, equal demonstration is used again.

    Raises:
        PipelineError: the folder cannot be used.
    """
    film(folder, common)
    project = write_project(folder)
    run = folder / "run"
    rows = run_project(project, run, common)
    failed = [row for row in rows if row.failure]
    if failed:
        raise PipelineError(f"{failed[0].path}: {failed[0].failure}")
    return evaluate(project, run)


def write_project(folder: Path) -> Project:
    """The demonstration's project, and its file where there is none: another is the user's own.

    Raises:
        PipelineError: the file cannot be written.
    """
    path, entries = folder / "project.toml", _entries()
    if not path.exists():
        write_text(path, tomli_w.dumps({"recording": entries}))
    recordings = [ProjectRecording(**{**entry, "path": folder / entry["path"]}) for entry in entries]
    return Project(recordings=tuple(recordings), settings={})


def film(folder: Path, common: Common) -> None:
    """Write the recordings that are not there yet; equal seeds give equal bytes.

    Raises:
        PipelineError: the folder holds something else.
    """
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "recordings").is_dir():
        raise PipelineError(f"{folder} is not empty and holds no demonstration; name another with --out")
    (folder / "recordings").mkdir(parents=True, exist_ok=True)
    meshes = {name: built_in_object(name) for name in OBJECTS}
    for number, name in enumerate(OBJECTS):
        scene, seed = ObjectScene(camera=CAMERA, room=ROOM, path=ROUND_THE_OBJECT), common.seed + number
        _write(folder, name, partial(film_object, name, meshes[name]), scene, seed, common)
    scene = TableScene(objects=len(OBJECTS), path=AT_THE_TABLE)
    _write(folder, TABLE, partial(film_table, meshes), scene, common.seed, common)


def evaluate(project: Project, run: Path) -> DemoResult:
    """Compare a finished run with the truth in its recordings."""
    learned, shape_from_object = {}, {}
    for recording in (one for one in project.recordings if one.stage == "learn"):
        values, truth = _values(recording, run), RecordedTruth(recording.path)
        slam, shape, one = values.slam, values.shapes[recording.shape], truth.scene.objects[0]
        assert slam is not None  # learning needs it
        reference_from_object = truth.reference_from_object(one, slam.tracked_path)
        learned[recording.shape] = LearnedObject(
            trajectory_error_cm=100 * slam_errors(slam, truth.trajectory)["ate_first_pose_m"],
            iou=shape_agreement(shape, true_mesh(one), reference_from_object).solid,
        )
        shape_from_object[recording.shape] = np.linalg.inv(shape.reference_from_grid) @ reference_from_object
    parsed = [
        error
        for recording in project.recordings
        if recording.stage == "parse"
        for error in _parsed(recording, run, shape_from_object)
    ]
    return DemoResult(learned=learned, parsed=parsed)


def _parsed(
    recording: ProjectRecording, run: Path, shape_from_object: dict[str, NDArray[np.float64]]
) -> list[ObjectError]:
    values, truth = _values(recording, run), RecordedTruth(recording.path)
    assert values.scene is not None
    return object_errors(
        truth.scene.objects,
        {one.shape: true_mesh(one) for one in truth.scene.objects},
        truth.camera_from_world(values.parsed_time_ns),
        values.scene.found_poses,
        shape_from_object,
    )


def _values(recording: ProjectRecording, run: Path) -> RunValues:
    return RunValues.load(RunFolder(recording_folder(run, recording), force=False))


def _write(
    folder: Path,
    name: str,
    film_of: Callable[[Scene, int], SyntheticRecording],
    scene: Scene,
    seed: int,
    common: Common,
) -> None:
    """Film a scene, unless the recording is there that the same program made of it with the same seed."""
    path = folder / "recordings" / f"{name}.mcap"
    record = path.with_suffix(".json")
    sources = source_hash(*FILMED_BY, within=PROGRAM)
    made_from = canonical_hash([sources, name, OBJECTS, plain_values({"scene": scene}), seed])
    with suppress(OSError, ValueError):
        if json.loads(record.read_text()) == {"made_from": made_from, "hash": file_hash(path)}:
            log.info("filming %s: unchanged", name)
            return
    with common.progress(f"filming {name}", "frames") as progress:
        write_recording(film_of(scene, seed), path, progress, mends=True)
    write_json(record, {"made_from": made_from, "hash": file_hash(path)})


def _entries() -> list[dict[str, Any]]:
    """The project's recordings."""
    learn = [{"path": f"recordings/{name}.mcap", "stage": "learn", "name": name} for name in OBJECTS]
    return [*learn, {"path": f"recordings/{TABLE}.mcap", "stage": "parse"}]
