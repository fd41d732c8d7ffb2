"""The times that all is logged at: number of the frame, seconds since the first, the recording's clock."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

FRAME, ELAPSED, RECORDED = "frame", "elapsed", "time"


def set_times(recording: rr.RecordingStream, frame: int, time_ns: int, first_ns: int) -> None:
    """What is logged from now on belongs to a frame."""
    recording.set_time(FRAME, sequence=frame)
    recording.set_time(ELAPSED, duration=(time_ns - first_ns) / 1e9)
    recording.set_time(RECORDED, timestamp=np.datetime64(time_ns, "ns"))


def time_columns(times_ns: NDArray[np.int64]) -> list[rr.TimeColumn]:
    """The same of frames (T,) one after another."""
    return [
        rr.TimeColumn(FRAME, sequence=np.arange(len(times_ns))),
        rr.TimeColumn(ELAPSED, duration=(times_ns - times_ns[0]) / 1e9),
        rr.TimeColumn(RECORDED, timestamp=times_ns.astype("datetime64[ns]")),
    ]
