"""What an hour of film costs: memory, kernels compiled anew on the way, and whether frames get slower."""

from __future__ import annotations

import resource
import tempfile
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from pipeline.benchmarks.flats import flat_film
from pipeline.memory import give_back_free_memory
from pipeline.progress import Report
from pipeline.timing import kernels_counted, own_processor_clock, processor_clock
from recordings.types import Frame
from slam.config import SlamConfig
from slam.filter.state import FrameInfo
from slam.keyframes.pages import PageFile
from slam.tracking import track

ROW = "an hour, twenty rooms"
STARTED = 1000
"""Frames by which every kernel of tracking should have been compiled."""


def hour_row(frames: int, seed: int, report: Report) -> dict[str, Any]:
    """Figures of one film.

    Args:
        frames: of it; an hour has 100,000.
        seed: number of the flat.
        report: is told how many frames of how many are done.
    """
    film = flat_film(frames, seed)
    rendering_s, keyframes, marks, compiled, tracked = 0.0, 0, [processor_clock()], 0, 0

    def rendered() -> Iterator[Frame]:
        nonlocal rendering_s
        for index in range(frames):
            begun_s = own_processor_clock()
            frame = film.frame(index)
            rendering_s += own_processor_clock() - begun_s
            yield frame

    with kernels_counted() as kernels, tempfile.TemporaryFile() as pages:

        def on_frame(info: FrameInfo) -> None:
            nonlocal keyframes, compiled, tracked
            marks.append(processor_clock() - rendering_s)
            keyframes, tracked = info.keyframes, kernels()
            if len(marks) <= STARTED + 1:
                compiled = tracked
            if len(marks) % STARTED == STARTED // 10:
                give_back_free_memory()
            report(len(marks) - 1, frames)

        result = track(
            jax.random.key(seed), rendered(), film.intrinsics, SlamConfig(), on_frame, pages=PageFile(pages)
        )
        refining = kernels() - tracked
        refining_s = processor_clock() - rendering_s - marks[-1]
    poses = film.trajectory.reference_from_camera
    errors_m = np.linalg.norm(result.mean[:, :3, 3] - (np.linalg.inv(poses[0]) @ poses)[:, :3, 3], axis=1)
    tenth = max(frames // 10, 1)
    first = slice(min(STARTED, tenth), min(STARTED, tenth) + tenth)
    steps = np.diff(marks)
    return {
        "row": ROW,
        "frames": frames,
        "keyframes": keyframes,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "kernels_after_start": tracked - compiled,
        "kernels_of_refinement": refining,
        "ms_a_frame": 1e3 * float(steps[STARTED:].mean()) if frames > STARTED else None,
        "last_to_first_tenth": float(steps[first].mean() / steps[-tenth:].mean()),
        "refining_s": refining_s,
        "lost_frames": int(result.lost.sum()),
        "median_m": float(np.median(errors_m)),
        "worst_m": float(errors_m[~result.lost].max()),
        "end_m": float(errors_m[-1]),
        "told_end_m": float(np.sqrt(np.trace(result.covariance[-1, :3, :3]))),
    }
