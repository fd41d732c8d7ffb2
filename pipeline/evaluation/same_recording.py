"""Whether a truth is that of the recording that a run was made from.

Recordings are moved, cut and written anew, so that other files may hold the same frames: the views that a run
keeps (`room.npz`) are held against the frames of the same stamps in the recording of the truth.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.evaluation.trajectories import is_trajectory_file
from pipeline.fingerprints import recording_hash
from pipeline.logs import log
from pipeline.room import RoomView
from pipeline.run_folder import RunFolder
from recordings.errors import RecordingError
from recordings.options import ReadOptions
from recordings.reading import open_recording
from recordings.types import Frame

COMPARED_VIEWS = 5
SAME_MM, SAME_DEPTH_SHARE = 2, 0.01
"""Depths that differ by less than the larger of them are one: rounded, or seen without the sensor's noise."""
SAME_LEVELS = 8
"""Colours likewise, of 255: images may have been compressed again."""
SAME, OTHER = 0.95, 0.5
"""Shares of equal pixels: from the first on it is the same recording, below the second another."""


def check_truth(run: RunFolder, truth: Path) -> None:
    """Stop where a truth is that of another recording than the run's, and warn where it seems to be.

    A trajectory file is judged by the recording beside it, and never for certain.

    Args:
        run: of one recording.
        truth: a recording, or a TUM file.

    Raises:
        PipelineError: frames of the run's stamps show something else.
        RecordingError: the truth cannot be read.
    """
    if not is_trajectory_file(truth):
        _judge(run, truth, "truth")
    elif source := _recording_beside(run, truth):
        share = _equal_share(run, source)
        if share is not None and share < SAME:
            log.warning("%s lies beside %s, not the recording of %s: is it right?", truth, source, run.path)


def truth_options(run: RunFolder, *stages: str) -> ReadOptions:
    """How the first of these stages that a run holds read its recording: as its true poses are read, too.

    They are of all frames, and no depth is looked at.
    """
    record = next(filter(None, map(run.record, stages)), None)
    return replace(_of_all_frames(record.read_options if record else ReadOptions()), sensor=None)


def check_recording(run: RunFolder, recording: Path) -> None:
    """Stop where a recording is another than the run's, and warn where it seems to be.

    Raises:
        PipelineError: frames of the run's stamps show something else.
        RecordingError: the recording cannot be read.
    """
    _judge(run, recording, "recording")


def _judge(run: RunFolder, recording: Path, what: str) -> None:
    share = _equal_share(run, recording)
    if share is None:
        said = "is not the file it was made from, and no frame tells whether both are of one recording"
        log.warning("%s: %s %s", run.path, recording, said)
    elif share < OTHER:
        made_from = ", ".join(run.made_from) or "another one"
        raise PipelineError(
            f"{recording} is not the recording of {run.path}, which was made from {made_from}: at equal "
            f"stamps they show different things; name the {what} of that one"
        )
    elif share < SAME:
        said = f"{100 * share:.0f}% of the pixels of the recording of {run.path}"
        log.warning("%s shows only %s: is it the right %s?", recording, said, what)


def _recording_beside(run: RunFolder, trajectory: Path) -> Path | None:
    """The recording of a trajectory file's name, or the only one in its folder; None where none is meant."""
    beside = [path for path in sorted(trajectory.parent.glob("*.mcap*")) if path.is_file()]
    named = [path for path in beside if _stem(path) == trajectory.stem]
    is_named_by_run = trajectory.stem in map(_stem, map(Path, run.made_from))
    return next(iter(named or (beside if len(beside) == 1 and not is_named_by_run else [])), None)


def _stem(path: Path) -> str:
    return path.name.partition(".mcap")[0]


def _equal_share(run: RunFolder, source: Path) -> float | None:
    """Share of the pixels of the run's views that a recording shows alike; None without any to compare."""
    if recording_hash(source) in run.made_from.values():
        return 1.0
    record = run.record("room")
    if record is None:
        return None
    room = RoomView.load(run.value_path("room"))
    equal = [
        share
        for view, frame in _frames_of_views(room, source, _of_all_frames(record.read_options))
        if (share := _alike(room, view, frame)) is not None
    ]
    return float(np.mean(equal)) if equal else None


def _of_all_frames(options: ReadOptions) -> ReadOptions:
    """The same without those that leave something out."""
    return replace(options, start_s=0.0, end_s=math.inf, every=1, mask=None)


def _frames_of_views(room: RoomView, source: Path, options: ReadOptions) -> list[tuple[int, Frame]]:
    """A few views, and the frames of their stamps in a recording; none where it cannot be read so."""
    views = {int(stamp): view for view, stamp in enumerate(room.times_ns)}
    try:
        recording = open_recording(source, options)
        numbered = [(number, stamp) for number, stamp in enumerate(recording.stamps_ns()) if stamp in views]
        numbers = [number for number, _ in numbered[:: -(-len(numbered) // COMPARED_VIEWS) or 1]]
        return [(views[frame.time_ns], frame) for frame in recording.chosen(numbers)]
    except RecordingError:
        return []


def _alike(room: RoomView, view: int, frame: Frame) -> float | None:
    """Share of the pixels that both images measured which agree; of colours, where there is no depth."""
    seen_mm = room.depth_mm[view].astype(np.float64)
    step = -(-frame.depth_m.shape[1] // seen_mm.shape[1])
    now_mm = 1000 * frame.depth_m[::step, ::step].astype(np.float64)
    if now_mm.shape != seen_mm.shape:
        return None
    both = (seen_mm > 0) & (now_mm > 0)
    if both.any():
        allowed = np.maximum(SAME_MM, SAME_DEPTH_SHARE * seen_mm)
        return float((abs(now_mm - seen_mm) <= allowed)[both].mean())
    if room.view_rgb is None or frame.rgb is None:
        return None
    return _alike_colours(room.view_rgb[view], frame.rgb[::step, ::step])


def _alike_colours(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float | None:
    if one.shape != other.shape:
        return None
    return float((abs(one.astype(int) - other) <= SAME_LEVELS).all(axis=-1).mean())
