"""One scene of a BOP data set, or one folder of YCB-Video frames, with the true poses of its objects.

BOP: depth/, rgb/ or gray/, scene_camera.json, scene_gt.json; millimetres, `depth_scale` millimetres for
a stored 1 (bop_toolkit, docs/bop_datasets_format.md). YCB-Video: NNNNNN-depth.png in tenths of a
millimetre and gt.json, a list with K, objects and, for real scenes, the camera of each frame.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recordings.dataset_numbers import DatasetNumbers
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
from recordings.truth import SceneTruth, TrueObject

_COLOUR_SUFFIXES = (".png", ".jpg")
_SAME_CAMERA_PX = 1e-3
_STILL_M = 0.01
_STILL_RAD = 0.05


@dataclass(frozen=True, kw_only=True)
class Annotated:
    """One frame with what is known of it.

    Attributes:
        number: of the frame in its scene.
        files: its images.
        intrinsics: of its camera.
        depth_unit_m: metres for a stored 1.
        objects: shape and camera_from_object (4, 4) of each.
        camera_from_world: (4, 4); None where the data set does not say.
        visible_fractions: of the objects, where somebody counted.
        object_ids: the data set's number of each shape.
    """

    number: int
    files: ImageFiles
    intrinsics: Intrinsics
    depth_unit_m: float
    objects: tuple[tuple[str, NDArray[np.float64]], ...]
    camera_from_world: NDArray[np.float64] | None
    visible_fractions: tuple[float, ...] | None = None
    object_ids: tuple[tuple[str, int], ...] = ()


def read_bop(folder: Path, wanted: slice = ALL_FRAMES) -> Dataset:
    """The scene in a folder.

    The world is the data set's own. Where it has none, it is the first camera, and later cameras are
    placed by the objects, if these agree that they stand still.

    Raises:
        RecordingError: the folder is no such scene, or a file of it is malformed.
    """
    frames = annotated_frames(folder)[wanted]
    if not frames:
        raise RecordingError(f"{folder} has no annotated depth images")
    _check_one_camera(folder, frames)
    poses, assumptions = _poses(frames)
    by_time = {frame.files.time_ns: frame for frame in frames}
    truth, moving = scene_truth([(by_time[time_ns], pose) for time_ns, pose in poses])
    if moving:
        assumptions += (f"left out of the true scene, as they do not stand still: {', '.join(moving)}",)
    return Dataset(
        frames=[frame.files for frame in frames],
        intrinsics=frames[0].intrinsics,
        depth_unit_m=frames[0].depth_unit_m,
        poses=poses,
        truth=truth if truth.objects else None,
        assumptions=assumptions,
        numbers=_numbers(folder, frames),
    )


def _numbers(folder: Path, frames: list[Annotated]) -> DatasetNumbers:
    """The numbers of a scene: its folder's name, its images' and those of the objects annotated in it."""
    name = folder.resolve().name
    return DatasetNumbers(
        scene_id=int(name) if name.isdecimal() else 0,
        image_ids={frame.files.time_ns: frame.number for frame in frames},
        object_ids={name: number for frame in frames for name, number in frame.object_ids},
    )


def annotated_frames(folder: Path) -> list[Annotated]:
    """Every frame of a scene with what is known of it, by number.

    Raises:
        RecordingError: the folder is no scene, or a file of it is malformed.
    """
    existing_folder(folder)
    try:
        if (folder / "scene_camera.json").exists():
            return _bop_frames(folder)
        if (folder / "gt.json").exists():
            return _ycb_video_frames(folder)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError) as error:
        raise RecordingError(f"{folder}: its annotations are malformed ({error!r})") from error
    raise RecordingError(f"{folder} has neither scene_camera.json (BOP) nor gt.json (YCB-Video)")


def _bop_frames(folder: Path) -> list[Annotated]:
    cameras = _json(folder / "scene_camera.json")
    truths = _json(folder / "scene_gt.json") if (folder / "scene_gt.json").exists() else {}
    visible = _json(folder / "scene_gt_info.json") if (folder / "scene_gt_info.json").exists() else {}
    frames = []
    for key in sorted(cameras, key=int):
        camera, number = cameras[key], int(key)
        depth = folder / "depth" / f"{number:06d}.png"
        k = np.array(camera["cam_K"], np.float64).reshape(3, 3)
        infos = visible.get(key)
        if infos and len(infos) != len(truths.get(key, [])):
            raise ValueError(f"frame {number} has {len(infos)} entries in scene_gt_info.json")
        frames.append(
            Annotated(
                number=number,
                files=ImageFiles(stamp_ns(number), depth, _bop_colour(folder, number)),
                intrinsics=(k[0, 0], k[1, 1], k[0, 2], k[1, 2]),
                depth_unit_m=float(camera["depth_scale"]) / 1000,
                objects=tuple(
                    (f"obj_{int(gt['obj_id']):06d}", _pose_mm(gt["cam_R_m2c"], gt["cam_t_m2c"]))
                    for gt in truths.get(key, [])
                ),
                camera_from_world=_pose_mm(camera["cam_R_w2c"], camera["cam_t_w2c"])
                if "cam_R_w2c" in camera
                else None,
                visible_fractions=tuple(float(info["visib_fract"]) for info in infos) if infos else None,
                object_ids=tuple(
                    (f"obj_{int(gt['obj_id']):06d}", int(gt["obj_id"])) for gt in truths.get(key, [])
                ),
            )
        )
    return frames


def _ycb_video_frames(folder: Path) -> list[Annotated]:
    frames = []
    for entry in _json(folder / "gt.json"):
        name, number = str(entry["frame"]), int(entry["frame"])
        colour = next((p for s in _COLOUR_SUFFIXES if (p := folder / f"{name}-color{s}").exists()), None)
        k = np.array(entry["K"], np.float64).reshape(3, 3)
        frames.append(
            Annotated(
                number=number,
                files=ImageFiles(stamp_ns(number), folder / f"{name}-depth.png", colour),
                intrinsics=(k[0, 0], k[1, 1], k[0, 2], k[1, 2]),
                depth_unit_m=1 / float(entry.get("depth_units_per_m", 10000.0)),
                objects=tuple(
                    (str(item["name"]), orthonormalised(np.array(item["T_cam_obj"]).reshape(4, 4)))
                    for item in entry["objects"]
                ),
                camera_from_world=orthonormalised(np.array(entry["T_cam_world"]).reshape(4, 4))
                if entry.get("T_cam_world") is not None
                else None,
                object_ids=tuple(
                    (str(item["name"]), int(item["cls_index"]))
                    for item in entry["objects"]
                    if "cls_index" in item
                ),
            )
        )
    return sorted(frames, key=lambda frame: frame.number)


def _bop_colour(folder: Path, number: int) -> Path | None:
    candidates = (
        folder / kind / f"{number:06d}{suffix}" for kind in ("rgb", "gray") for suffix in _COLOUR_SUFFIXES
    )
    return next((path for path in candidates if path.exists()), None)


def _pose_mm(rotation: Any, translation_mm: Any) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(rotation, np.float64).reshape(3, 3)
    matrix[:3, 3] = np.array(translation_mm, np.float64).reshape(3) / 1000
    return orthonormalised(matrix)


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding=TEXT))
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{path} is not JSON: {error}") from error


def _check_one_camera(folder: Path, frames: list[Annotated]) -> None:
    first = frames[0]
    for frame in frames[1:]:
        if np.abs(np.subtract(frame.intrinsics, first.intrinsics)).max() > _SAME_CAMERA_PX:
            raise RecordingError(
                f"{folder}: frame {frame.number} has other intrinsics than frame {first.number}; "
                "import them one by one with --frames"
            )
        if frame.depth_unit_m != first.depth_unit_m:
            raise RecordingError(f"{folder}: frame {frame.number} has another depth scale than the first")


def _poses(
    frames: list[Annotated],
) -> tuple[list[tuple[int, NDArray[np.float64]]], tuple[str, ...]]:
    """Stamped world_from_camera; the first frame always has one."""
    if all(frame.camera_from_world is not None for frame in frames):
        found = [(f.files.time_ns, np.linalg.inv(f.camera_from_world)) for f in frames]  # pyright: ignore
        return found, ()
    placed = [(frame.files.time_ns, _relative_camera(frames[0], frame)) for frame in frames]
    poses = [(time_ns, pose) for time_ns, pose in placed if pose is not None]
    if len(poses) == len(frames):
        return poses, ()
    left = len(frames) - len(poses)
    return poses, (f"objects do not stand still, or none is common: {left} frames have no camera truth",)


def _relative_camera(first: Annotated, frame: Annotated) -> NDArray[np.float64] | None:
    """first_from_camera by the objects that stand in both frames, if they agree on it.

    One object alone cannot disagree: it is believed only where it is all that the frames show.
    """
    if frame is first:
        return np.eye(4)
    names = Counter(name for name, _ in first.objects) | Counter(name for name, _ in frame.objects)
    then, now = dict(first.objects), dict(frame.objects)
    common = [name for name in then if name in now and names[name] == 1]
    motions = [then[name] @ np.linalg.inv(now[name]) for name in common]
    if not motions or (len(motions) == 1 and len(names) > 1):
        return None
    for motion in motions[1:]:
        if not _is_still(motions[0], motion):
            return None
    return orthonormalised(np.mean(motions, axis=0))


def _is_still(pose: NDArray[np.float64], later: NDArray[np.float64]) -> bool:
    """Whether two poses (4, 4) differ by no more than annotations of what stands still."""
    difference = np.linalg.inv(pose) @ later
    angle = np.arccos(np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1))
    return bool(np.linalg.norm(difference[:3, 3]) <= _STILL_M and angle <= _STILL_RAD)


def scene_truth(
    placed: Sequence[tuple[Annotated, NDArray[np.float64]]],
) -> tuple[SceneTruth, tuple[str, ...]]:
    """The objects of frames in the world, each where it was annotated first; copies of a shape are numbered.

    Args:
        placed: frames with world_from_camera (4, 4).

    Returns:
        What stands still, and the shapes of what does not, which are left out: they are annotated at more
        places than in any single frame.
    """
    found: list[TrueObject] = []
    most: Counter[str] = Counter()
    for number, (frame, world_from_camera) in enumerate(placed):
        most |= Counter(shape for shape, _ in frame.objects)
        known = list(found)
        for index, (shape, camera_from_object) in enumerate(frame.objects):
            pose = world_from_camera @ camera_from_object
            again = [one for one in known if one.shape == shape and _is_still(one.world_from_object, pose)]
            if again:
                known.remove(min(again, key=lambda one: _apart_m(one.world_from_object, pose)))
                continue
            copies = sum(one.shape == shape for one in found)
            counted = frame.visible_fractions if number == 0 else None  # of the first frame alone
            found.append(
                TrueObject(
                    name=f"{shape}_{copies + 1}" if copies else shape,
                    shape=shape,
                    world_from_object=pose,
                    visible_fraction=counted[index] if counted else None,
                )
            )
    places = Counter(one.shape for one in found)
    moving = tuple(shape for shape in places if places[shape] > most[shape])
    return SceneTruth(objects=tuple(one for one in found if one.shape not in moving)), moving


def _apart_m(pose: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(pose[:3, 3] - other[:3, 3]))
