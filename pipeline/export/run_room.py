"""The room of a finished run as triangles, fused from the recording that the run was made from."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.evaluation.same_recording import check_recording
from pipeline.export.room_mesh import MOST_FRAMES, room_mesh
from pipeline.fingerprints import recording_hash
from pipeline.options import Common
from pipeline.run_folder import RunFolder
from recordings.errors import RecordingError
from recordings.options import ReadOptions
from recordings.reading import McapRecording, open_recording
from recordings.types import Frame
from slam.result import SlamResult


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackedFrames:
    """The frames of a recording that a run tracked, with their poses; may be gone through repeatedly.

    Attributes:
        recording: the frames.
        poses: reference_from_camera (4, 4) by stamp.
    """

    recording: McapRecording
    poses: dict[int, NDArray[np.float64]]

    def __call__(self) -> Iterator[tuple[Frame, NDArray[np.float64]]]:
        """Every frame that has a pose, with it."""
        return ((frame, self.poses[frame.time_ns]) for frame in self.recording if frame.time_ns in self.poses)

    def thinned(self, count: int) -> TrackedFrames:
        """At most so many of them, spread evenly."""
        step = max(1, -(-len(self.poses) // count))
        kept = sorted(self.poses)[::step]
        return TrackedFrames(recording=self.recording, poses={time: self.poses[time] for time in kept})


def tracked_frames(run: Path, recording: Path | None = None) -> TrackedFrames:
    """The frames that a run's slam did not lose.

    Args:
        run: run folder with a finished slam.
        recording: that the run was made from; None looks for it near the run and in the working directory.

    Raises:
        PipelineError: the run has no trajectory, lost every frame, or its recording is not found or another.
    """
    folder = RunFolder(run, force=False)
    record = folder.record("slam")
    if record is None:
        raise PipelineError(
            f"{run} holds no finished slam, so no room; make it with voxscene slam REC -o {run}"
        )
    result = SlamResult.load(folder.value_path("slam"))
    if result.lost.all():
        raise PipelineError(f"slam lost every frame of {run}, there is no room to fuse")
    path = _checked(run, recording)
    poses = dict(zip(result.times_ns[~result.lost].tolist(), result.mean[~result.lost], strict=True))
    return TrackedFrames(recording=open_recording(path, record.read_options), poses=poses)


def open_parsed(run: Path, recording: Path | None = None) -> McapRecording:
    """The recording that a run's parse was made from, read as it was then.

    Args:
        run: run folder with a finished parse.
        recording: where it is; None looks for it near the run and in the working directory.

    Raises:
        PipelineError: it is not found, or another.
    """
    record = RunFolder(run, force=False).record("parse")
    return open_recording(_checked(run, recording), record.read_options if record else ReadOptions())


def run_room(run: Path, recording: Path | None, pitch_m: float, common: Common) -> trimesh.Trimesh:
    """The room of a run as coloured triangles in its reference frame.

    Raises:
        PipelineError: as `tracked_frames`, or too little was seen.
    """
    frames = tracked_frames(run, recording).thinned(MOST_FRAMES)
    count = len(frames.poses)
    with common.progress("room", "frames") as progress:
        return room_mesh(
            frames, frames.recording.intrinsics, pitch_m=pitch_m, progress=lambda done: progress(done, count)
        )


def _checked(run: Path, recording: Path | None) -> Path:
    """The recording that was named, if it shows what the run's does; else the one that is found."""
    if recording is None:
        return _recording_of(run)
    check_recording(RunFolder(run, force=False), recording)
    return recording


def _recording_of(run: Path) -> Path:
    """The recording that a run was made from, found by its name and known by its hash.

    Looked for in the folders above the run, in their `recordings`, and in the working directory.
    """
    made_from = RunFolder(run).made_from
    if not made_from:
        raise PipelineError(f"{run} does not say what it was made from; name it with --recording REC")
    name, digest = next(iter(made_from.items()))
    above = list(run.resolve().parents)[:4]
    for folder in (*above, *(one / "recordings" for one in above), Path.cwd()):
        path = folder / name
        with suppress(RecordingError):  # a folder of that name that holds no recording
            if path.exists() and recording_hash(path) == digest:
                return path
    raise PipelineError(f"{name}, of which {run} was made, is not near it; name it with --recording REC")
