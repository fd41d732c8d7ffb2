"""Synthetic recordings as files: depth, colour, and the truth in topics that only `eval` reads."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pipeline.synthesis.recording import SyntheticRecording
from recordings.dataset_numbers import DatasetNumbers, write_dataset_numbers
from recordings.truth import write_scene_truth
from recordings.writer import RecordingWriter

MILLIMETRE_M = 0.001


def write_recording(
    recording: SyntheticRecording,
    path: Path,
    progress: Callable[[int, int], None] | None = None,
    numbers: DatasetNumbers | None = None,
    *,
    mends: bool = False,
) -> None:
    """Write an MCAP file whole or not at all.

    Depth is stored in 16-bit millimetres where the sensor's quantisation allows, else in 32-bit metres.

    Args:
        recording: what is filmed.
        path: of the file.
        progress: is told frames done and frames in all.
        numbers: of the scene, image and objects, where it belongs to a data set.
        mends: as `RecordingWriter` has it.

    Raises:
        RecordingError: the file cannot be written.
    """
    poses = recording.trajectory.reference_from_camera
    unit_m = MILLIMETRE_M if recording.sensor.in_millimetres else None
    with RecordingWriter(path, recording.intrinsics, depth_unit_m=unit_m, mends=mends) as writer:
        write_scene_truth(writer, recording.truth, int(recording.trajectory.times_ns[0]))
        if numbers is not None:
            write_dataset_numbers(writer, numbers, int(recording.trajectory.times_ns[0]))
        for index, frame in enumerate(recording):
            writer.write_camera_pose(frame.time_ns, poses[index])
            writer.write_depth(frame)
            if progress:
                progress(index + 1, len(recording))
