"""What `bench slam` tracks: real recordings with poses, and seeded synthetic rooms."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.synthesis.filming import film_object
from pipeline.synthesis.objects import built_in_names, built_in_object
from pipeline.synthesis.paths import PathConfig, camera_path
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.rooms import RoomConfig, room_parts
from pipeline.synthesis.scenarios import CameraConfig, ObjectScene
from pipeline.synthesis.sensor import DepthSensor
from recordings.importers.formats import import_recording
from recordings.options import ReadOptions
from recordings.poses.recorded import recorded_trajectory
from recordings.poses.rigid import orthonormalised
from recordings.reading import open_recording
from recordings.types import CameraIntrinsics, Frame
from slam.config import SlamConfig

RADIUS_M = 1.5
ELEVATION_DEG = 12.0
TARGET_M = np.array([0.0, 0.0, 0.9])
ROOM_M, SIZE_SPREAD, OFF_CENTRE_M = 4.0, 0.05, 0.15
FIELD_OF_VIEW_DEG = 70.0
"""Orbits look across the room so that a corner is always in view: where only one wall and the floor are
seen, the motion along that wall leaves no trace in depth, and errors would tell of the room alone."""
KITCHEN_FRAMES = 400
SHORT_WALK_FRAMES = 8
SHORT_WALK_DEGREES = (0.5, 6.0)
"""A frame, drawn anew for each short walk."""
ORBIT_FRAMES = {1: 60, 6: 60, 12: 30}
"""Degrees a frame, and frames: the wider ones are whole circles."""
UNEVEN = 0.3
"""Share by which steps of circles that are walked unevenly differ from their mean, at most."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """One recording to be tracked.

    Attributes:
        frames: all of them.
        intrinsics: the camera.
        poses: (T, 4, 4) true first_camera_from_camera.
        object_m: (3,) centre of the object that is filmed, in the first camera; None without one.
    """

    frames: Sequence[Frame]
    intrinsics: CameraIntrinsics
    poses: NDArray[np.float64]
    object_m: NDArray[np.float64] | None = None


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the table: cases of one kind, and how ours is set for them.

    Attributes:
        name: of the line.
        case: the case of a number; real rows have number 0 alone.
        real: whether it is a real recording.
        judged_by: the trajectory from its first pose, its end, or the places that it gives to the object.
        configs: ours, by the name of each setting.
    """

    name: str
    case: Callable[[int], Case]
    real: bool = False
    judged_by: Literal["trajectory", "end", "object"] = "trajectory"
    configs: Mapping[str, SlamConfig] = field(default_factory=lambda: {"voxscene": SlamConfig()})


def real_rows(data: Path) -> list[Row]:
    """Hand-held recordings under the folder `data`."""
    rows = [
        Row(name=f"real: redkitchen, every {every}", case=kitchen(data, every), real=True)
        for every in (1, 5, 10)
    ]
    shelf = data / "apc_shelf_handheld"
    for every, name in ((1, "real: apc_shelf_handheld"), (4, "real: apc_shelf_handheld, every 4")):
        rows.append(Row(name=name, case=partial(_imported, shelf, every), real=True))
    return rows


def kitchen(data: Path, every: int) -> Callable[[int], Case]:
    """Every so many-th frame of the kitchen under the folder `data`, whatever the number."""
    return partial(_imported, data / "sevenscenes_redkitchen", every)


def synthetic_rows() -> list[Row]:
    """Orbits in bare and furnished rooms, views round an object, whole circles of few views."""
    known = {
        "voxscene": SlamConfig(),
        "voxscene, radius known": SlamConfig(motion="orbit", orbit_radius_m=RADIUS_M),
    }
    bare = [
        Row(
            name=f"bare room, {degrees} degrees a frame",
            case=partial(_orbit, "bare", degrees, frames),
            configs=known,
        )
        for degrees, frames in ORBIT_FRAMES.items()
    ]
    furnished = [
        Row(
            name=f"furnished room, {degrees} degrees a frame",
            case=partial(_orbit, "furnished", degrees, frames),
        )
        for degrees, frames in ORBIT_FRAMES.items()
    ]
    views = [
        Row(name=f"{count} views round an object", case=partial(_object_views, count), judged_by="object")
        for count in (5, 10, 20)
    ]
    circles = [
        Row(
            name=f"bare room, whole circle of {count}{walked}",
            case=partial(_orbit, "bare", 360 / count, count, uneven=uneven),
            configs=known,
        )
        for walked, uneven in (("", 0.0), (" walked unevenly", UNEVEN))
        for count in (5, 12)
    ]
    return [*bare, *furnished, *views, *circles]


def _imported(folder: Path, every: int, number: int) -> Case:
    """The first frames of a folder in the layout of 7-Scenes, as slam reads them."""
    del number
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "recording.mcap"
        import_recording(
            "7scenes",
            folder,
            path,
            frames=slice(0, KITCHEN_FRAMES),
            intrinsics=None,
            progress=_untold,
        )
        options = ReadOptions(every=every)
        recording = open_recording(path, options)
        frames = list(recording)
        trajectory = recorded_trajectory(path, options)
    assert trajectory is not None
    nearest = np.abs(trajectory.times_ns[None] - [[frame.time_ns] for frame in frames]).argmin(axis=1)
    poses = orthonormalised(trajectory.reference_from_camera[nearest])
    return Case(frames=frames, intrinsics=recording.intrinsics, poses=np.linalg.inv(poses[0]) @ poses)


def _untold(done: int, total: int) -> None:
    """The importer's progress; the benchmark shows its own."""
    del done, total


def _orbit(
    kind: Literal["bare", "furnished"], degrees: float, frames: int, number: int, *, uneven: float = 0.0
) -> Case:
    """An orbit in the room of that number; the same room at every rate of even steps."""
    rng = np.random.default_rng([number, 77_001])
    path = PathConfig(
        frames=frames,
        degrees_per_frame=degrees,
        uneven=uneven,
        radius_m=RADIUS_M,
        elevations_deg=(ELEVATION_DEG,),
        look_at_error_deg=0.5,
    )
    poses = camera_path(path, TARGET_M, rng)
    room = RoomConfig(
        kind=kind, width_m=ROOM_M, depth_m=ROOM_M, size_spread=SIZE_SPREAD, off_centre_m=OFF_CENTRE_M
    )
    camera = CameraConfig(fx=160.0 / np.tan(np.radians(FIELD_OF_VIEW_DEG / 2)))
    parts = room_parts(room, RADIUS_M, rng)
    return filmed(SyntheticRecording.of_surroundings(parts, poses, camera.intrinsics, DepthSensor(), number))


def short_walk(number: int, distortion_per_m: float = 0.0) -> Case:
    """Eight frames at 160x120 of a hand-held camera in a furnished room, room and path of that number.

    The camera's distortion field, of that standard deviation, is drawn for each number, too.
    """
    rng = np.random.default_rng([number, 77_002])
    path = PathConfig(
        kind="handheld",
        frames=SHORT_WALK_FRAMES,
        degrees_per_frame=rng.uniform(*SHORT_WALK_DEGREES),
        radius_m=rng.uniform(0.8, 1.6),
        elevations_deg=(rng.uniform(0.0, 40.0),),
    )
    poses = camera_path(path, TARGET_M, rng)
    sensor = DepthSensor(distortion_per_m=distortion_per_m)
    return filmed_in_furnished_room(poses, path.radius_m, sensor, rng, number)


def filmed_in_furnished_room(
    poses: NDArray[np.float64], radius_m: float, sensor: DepthSensor, rng: np.random.Generator, number: int
) -> Case:
    """What a camera of 160x120 at (T, 4, 4) sees of a room with things in it, drawn by `rng`."""
    room = RoomConfig(kind="furnished", width_m=ROOM_M, depth_m=ROOM_M)
    parts, camera = room_parts(room, radius_m, rng), CameraConfig(width=160, height=120)
    return filmed(SyntheticRecording.of_surroundings(parts, poses, camera.intrinsics, sensor, number))


def _object_views(count: int, number: int) -> Case:
    """Views on two rings round an object on a pedestal in a furnished room."""
    name = built_in_names()[number % len(built_in_names())]
    scene = ObjectScene(
        path=PathConfig(kind="rings", frames=count, elevations_deg=(25.0, 55.0), radius_m=0.8)
    )
    recording = film_object(name, built_in_object(name), scene, seed=77_000 + number)
    true = recording.truth.objects[0]
    assert true.vertices_m is not None
    middle = 0.5 * (true.vertices_m.min(axis=0) + true.vertices_m.max(axis=0))
    return filmed(recording, true.world_from_object @ np.append(middle, 1.0))


def filmed(recording: SyntheticRecording, object_world: NDArray[np.float64] | None = None) -> Case:
    """All frames of a recording, with poses from the first camera."""
    poses = recording.trajectory.reference_from_camera
    first_from_world = np.linalg.inv(poses[0])
    return Case(
        frames=list(recording),
        intrinsics=recording.intrinsics,
        poses=first_from_world @ poses,
        object_m=None if object_world is None else (first_from_world @ object_world)[:3],
    )
