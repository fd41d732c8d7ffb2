"""Rigid transforms sampled in time."""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right

import numpy as np
from numpy.typing import NDArray

from recordings.messages.types import quaternion_xyzw, rigid_matrix

LONGEST_GAP_NS = 500_000_000
"""Between samples farther apart nothing is interpolated: the camera may have been anywhere."""
TOLERANCE_NS = 20_000_000
"""How far before its first and after its last sample a track still answers."""


class Track:
    """A transform over time, from samples in any order.

    Args:
        is_mounting: whether the recorder says that it never changes.
    """

    def __init__(self, *, is_mounting: bool = False) -> None:
        self.is_mounting = is_mounting
        self._times = array("q")
        self._matrices = array("d")
        self._sorted: tuple[NDArray[np.int64], NDArray[np.float64], bool] | None = None

    def add(self, time_ns: int, matrix: NDArray[np.float64]) -> None:
        """Take in a sample (4, 4)."""
        self._times.append(time_ns)
        self._matrices.extend(matrix.ravel().tolist())
        self._sorted = None

    @property
    def moves(self) -> bool:
        """Whether its samples differ."""
        return not self._samples()[2]

    def at(self, time_ns: int, *, holds: bool = False) -> NDArray[np.float64] | None:
        """The transform (4, 4) at a time: constant, or linear in position and turning at constant speed.

        None where no sample is near enough. A mounting holds from each sample to the next, as ROS latches
        /tf_static, and the first holds before it too. Samples that do not differ hold between them.

        Args:
            time_ns: the time.
            holds: whether samples that do not differ hold before and after them, too.
        """
        times, matrices, is_constant = self._samples()
        if is_constant and (holds or times[0] <= time_ns <= times[-1]):
            return matrices[0]
        if self.is_mounting:
            return matrices[max(0, bisect_right(times, time_ns) - 1)]
        after = bisect_left(times, time_ns)
        if after < len(times) and times[after] == time_ns:
            return matrices[after]
        if after in {0, len(times)}:
            end = 0 if after == 0 else len(times) - 1
            return matrices[end] if abs(int(times[end]) - time_ns) <= TOLERANCE_NS else None
        gap = int(times[after] - times[after - 1])
        if gap > LONGEST_GAP_NS:
            return None
        return _between(matrices[after - 1], matrices[after], (time_ns - int(times[after - 1])) / gap)

    def _samples(self) -> tuple[NDArray[np.int64], NDArray[np.float64], bool]:
        if self._sorted is None:
            times = np.array(self._times)
            order = np.argsort(times, kind="stable")
            matrices = np.array(self._matrices).reshape(-1, 4, 4)[order]
            self._sorted = times[order], matrices, bool((matrices == matrices[0]).all())
        return self._sorted


def _between(a: NDArray[np.float64], b: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """The transform a share of the way from a to b: slerp (Shoemake 1985) and a straight line."""
    start, end = np.array(quaternion_xyzw(a[:3, :3])), np.array(quaternion_xyzw(b[:3, :3]))
    cosine = float(start @ end)
    if cosine < 0:
        end, cosine = -end, -cosine
    angle = np.arccos(min(1.0, cosine))
    if angle < 1e-6:
        turned = (1 - share) * start + share * end
    else:
        turned = (np.sin((1 - share) * angle) * start + np.sin(share * angle) * end) / np.sin(angle)
    x, y, z = ((1 - share) * a[:3, 3] + share * b[:3, 3]).tolist()
    qx, qy, qz, qw = turned.tolist()
    return rigid_matrix((x, y, z), (qx, qy, qz, qw))
