"""What an importer finds in a folder of images, and writing it as a recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recordings.dataset_numbers import DatasetNumbers, write_dataset_numbers
from recordings.errors import RecordingError
from recordings.images.colour import decode_colour
from recordings.images.compressed_depth import decode_grey16_png
from recordings.images.depth_pixels import MetricDepth
from recordings.messages.types import CompressedImageMessage, UndecodableMessage
from recordings.settings import TEXT
from recordings.truth import SceneTruth, write_scene_truth
from recordings.types import CameraIntrinsics, Frame
from recordings.writer import RecordingWriter

ALL_FRAMES = slice(None)

FRAME_RATE_HZ = 30
"""Of cameras whose data sets number their frames instead of stamping them."""

_LAST_NS = ((1 << 31) - 2) * 1_000_000_000
"""Stamps of ROS 2 have 31 bits of seconds; poses reach a second over the last frame."""
_MARGIN_NS = 1_000_000_000
"""Poses this long before the first and after the last frame are written: one interpolates between them."""

Intrinsics = tuple[float, float, float, float]


@dataclass(frozen=True)
class ImageFiles:
    """The files of one frame."""

    time_ns: int
    depth: Path
    colour: Path | None = None


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """A sequence of depth images of one camera, with the truth that came with it.

    Attributes:
        frames: by increasing time.
        intrinsics: fx, fy, cx, cy in pixels.
        depth_unit_m: metres for a stored 1.
        poses: stamped world_from_camera (4, 4) rigid transforms.
        truth: the objects in the world of `poses`.
        assumptions: sentences on what the folder does not say, or says of no scene at rest.
        assumed_intrinsics: sentences on intrinsics that are not the folder's.
        numbers: by which the data set names scene, images and objects.
    """

    frames: Sequence[ImageFiles]
    intrinsics: Intrinsics
    depth_unit_m: float
    poses: Sequence[tuple[int, NDArray[np.float64]]] = ()
    truth: SceneTruth | None = None
    assumptions: tuple[str, ...] = ()
    assumed_intrinsics: tuple[str, ...] = ()
    numbers: DatasetNumbers | None = None


def write_dataset(dataset: Dataset, out: Path, progress: Callable[[int, int], None]) -> None:
    """Write a data set as a recording.

    Args:
        dataset: the data set.
        out: the MCAP file to write.
        progress: is told how many frames of how many are written.

    Raises:
        RecordingError: a file is missing, damaged or of another size, or `out` cannot be written.
    """
    if not dataset.frames:
        raise RecordingError("there are no depth images to import")
    if not 0 < dataset.depth_unit_m <= 1:
        raise RecordingError(
            f"a stored depth of 1 is said to be {dataset.depth_unit_m} m; it has to be above 0 and at most 1"
        )
    metric = MetricDepth(dataset.depth_unit_m)
    height, width = _depth(dataset.frames[0].depth).shape
    camera = _camera(dataset.intrinsics, width, height)
    _check_times(dataset.frames)
    # ROS has no stamps before zero, where data sets that number their frames begin.
    begin, end = max(0, dataset.frames[0].time_ns - _MARGIN_NS), dataset.frames[-1].time_ns + _MARGIN_NS
    poses = sorted((p for p in dataset.poses if begin <= p[0] <= end), key=lambda stamped: stamped[0])
    written = 0
    profile = "ros2" if dataset.truth is None else ""
    with RecordingWriter(out, camera, depth_unit_m=dataset.depth_unit_m, profile=profile) as writer:
        for count, files in enumerate(dataset.frames):
            stored = _depth(files.depth)
            if stored.shape != (height, width):
                size = f"{stored.shape[1]}x{stored.shape[0]}"
                raise RecordingError(f"{files.depth} is {size} where the first is {width}x{height}")
            while written < len(poses) and poses[written][0] <= files.time_ns:
                writer.write_camera_pose(*poses[written])
                written += 1
            frame = Frame(time_ns=files.time_ns, depth_m=metric(stored))
            if files.colour is not None:
                frame = replace(frame, rgb=_colour(files.colour, (height, width)))
            writer.write_depth(frame)
            if count == 0 and dataset.truth is not None:
                write_scene_truth(writer, dataset.truth, files.time_ns)
            if count == 0 and dataset.numbers is not None:
                write_dataset_numbers(writer, dataset.numbers, files.time_ns)
            progress(count + 1, len(dataset.frames))
        for time_ns, pose in poses[written:]:
            writer.write_camera_pose(time_ns, pose)


def _camera(intrinsics: Intrinsics, width: int, height: int) -> CameraIntrinsics:
    fx, fy, cx, cy = intrinsics
    try:
        return CameraIntrinsics(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
    except ValueError as error:
        raise RecordingError(f"the camera cannot be used: {error}; give --intrinsics fx,fy,cx,cy") from error


def _check_times(frames: Sequence[ImageFiles]) -> None:
    for frame in frames:
        if not 0 <= frame.time_ns < _LAST_NS:
            raise RecordingError(
                f"{frame.depth} has the time {frame.time_ns / 1e9:g} s, outside of 0 to {_LAST_NS / 1e9:g} s"
            )


def read_frame(
    files: ImageFiles, intrinsics: Intrinsics, depth_unit_m: float
) -> tuple[Frame, CameraIntrinsics]:
    """One frame of a data set, with its camera.

    Raises:
        RecordingError: a file is missing, damaged or of another size than its depth image.
    """
    depth_m = MetricDepth(depth_unit_m)(_depth(files.depth))
    height, width = depth_m.shape
    camera = _camera(intrinsics, width, height)
    rgb = None if files.colour is None else _colour(files.colour, (height, width))
    return Frame(time_ns=files.time_ns, depth_m=depth_m, rgb=rgb), camera


def stamp_ns(number: int) -> int:
    """The time of a numbered frame."""
    return round(number * 1_000_000_000 / FRAME_RATE_HZ)


def existing_folder(path: Path) -> Path:
    """The folder, if it is one.

    Raises:
        RecordingError: it is not.
    """
    if not path.is_dir():
        raise RecordingError(f"{path} is not a folder")
    return path


def read_numbers(path: Path, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """The numbers of a text file, separated by white space or commas.

    Raises:
        RecordingError: the file cannot be read or holds something else.
    """
    try:
        return np.array(path.read_text(encoding=TEXT).replace(",", " ").split(), np.float64).reshape(shape)
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        expected = "x".join(map(str, shape))
        raise RecordingError(f"{path} does not hold {expected} numbers") from error


def _depth(path: Path) -> NDArray[np.uint16]:
    try:
        return decode_grey16_png(path.read_bytes())
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {error.strerror}") from error
    except UndecodableMessage as error:
        raise RecordingError(f"{path}: {error}") from error


def _colour(path: Path, shape: tuple[int, int]) -> NDArray[np.uint8]:
    try:
        message = CompressedImageMessage(stamp_ns=0, frame_id="", format="", data=path.read_bytes())
        rgb = decode_colour(message)
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {error.strerror}") from error
    except UndecodableMessage as error:
        raise RecordingError(f"{path}: {error}") from error
    if rgb.shape[:2] != shape:
        raise RecordingError(f"{path} has another size than its depth image")
    return rgb
