"""What the depths and stamps of a recording look like, and what about them cannot be right.

Bytes that are right may mean something else: another unit, another byte order, a clock that stepped back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN, CameraIntrinsics

_BINS_M = np.geomspace(1e-4, 1e4, 4001)
"""Edges of the histogram of depths: quantiles are right to half of a percent."""
_USUAL_M = (0.1, 5.0)
"""Between which the median depth of a room or a table lies: cameras for rooms measure from 0.1 to 10 m."""
_LEAST_MEASURED = 0.05
_LEAST_IN_VIEW = 0.7
_MANY_REPEATS = 0.1
_LEAST_SIDE_PX = 32
_SMOOTHER = 4.0
"""By how much smoother an image has to be with its bytes swapped, to be taken for one in the other order."""
_LATE_S = 1.0
"""Frames are written this late at most: a stamp that steps back further is that of a clock that was set."""
_SECOND_NS = 1_000_000_000


@dataclass(kw_only=True)
class DepthStatistics:
    """Counts over a recording's depth frames; grows by `add_frame` and `add_message`.

    Attributes:
        frames: messages that were selected.
        looked_at: frames that were decoded.
        identical_frames: messages with the same pixels as the one before them, others than zeros.
        blank_frames: messages that hold nothing but zeros.
        stamp_steps_back: messages with an earlier stamp than the one before them in the file.
        first_step_back_s: when the first of them came, after the first frame.
        largest_step_back_s: by how much they step back at most; None where only the recorder's clock tells.
        undecodable: messages of the depth topic that hold no depth image.
        camera_changes: times at which the camera's calibration changes, in seconds after the first frame.
        too_far: pixels of floats whose depth is a kilometre or more.
        fixed_frame: name of the frame of clouds that stand in one in which others move.
        share_in_view: of the points of the first cloud, those that its depth image is made from.
    """

    frames: int = 0
    looked_at: int = 0
    identical_frames: int = 0
    blank_frames: int = 0
    stamp_steps_back: int = 0
    first_step_back_s: float | None = None
    largest_step_back_s: float | None = None
    undecodable: int = 0
    camera_changes: Sequence[float] = ()
    too_far: int = 0
    fixed_frame: str | None = None
    share_in_view: float = 1.0
    swapped_is_smoother: int = 0
    _pixels: int = 0
    _measured: int = 0
    _histogram: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(_BINS_M) + 1, np.int64))
    _last_data: bytes = b""
    _stamps_ns: tuple[int, int] | None = None

    def add_stamp(self, time_ns: int) -> None:
        """A message of the depth topic in the order of the file."""
        first_ns, last_ns = self._stamps_ns or (time_ns, time_ns)
        if time_ns < last_ns:
            self.stamp_steps_back += 1
            if self.first_step_back_s is None:
                self.first_step_back_s = (last_ns - first_ns) / _SECOND_NS
            step_s = (last_ns - time_ns) / _SECOND_NS
            self.largest_step_back_s = max(step_s, self.largest_step_back_s or 0.0)
        self._stamps_ns = first_ns, time_ns

    def add_log_steps_back(self, seconds: Sequence[float]) -> None:
        """When the log time steps back in the file: by it messages are sorted, so that no stamp tells."""
        if seconds and not self.stamp_steps_back:
            self.stamp_steps_back, self.first_step_back_s = len(seconds), seconds[0]

    def add_message(self, data: bytes) -> None:
        """A selected message in the order of stamps."""
        self.frames += 1
        if data and not data.strip(b"\0"):
            self.blank_frames += 1
        else:
            self.identical_frames += self.frames > 1 and data == self._last_data
        self._last_data = data

    def add_frame(
        self, depth_m: NDArray[np.float32], stored: NDArray | None, scale_m: float | None = None
    ) -> None:
        """A decoded frame (H, W), the numbers that are stored, if any, and metres for a stored 1 if told."""
        self.looked_at += 1
        measured = depth_m[depth_m != NO_RETURN]
        self._pixels += depth_m.size
        self._measured += measured.size
        self._histogram += np.bincount(np.searchsorted(_BINS_M, measured), minlength=len(_BINS_M) + 1)
        if stored is not None and stored.dtype.kind == "f":
            self.too_far += int(np.count_nonzero(np.isfinite(stored) & (stored * (scale_m or 1) >= 1000)))
        elif stored is not None:
            self.swapped_is_smoother += _roughness(stored) > _SMOOTHER * _roughness(stored.byteswap())

    @property
    def measured_share(self) -> float | None:
        """Share of the pixels that measured something; None where no frame was decoded."""
        return self._measured / self._pixels if self._pixels else None

    @property
    def depth_m(self) -> tuple[float, float, float] | None:
        """The 1, 50 and 99% quantiles of the measured depths in metres; None where nothing was measured."""
        if not self._measured:
            return None
        reached = np.cumsum(self._histogram) / self._measured
        low, middle, high = (
            float(_BINS_M[min(int(np.searchsorted(reached, share)), len(_BINS_M) - 1)])
            for share in (0.01, 0.5, 0.99)
        )
        return round(low, 4), round(middle, 4), round(high, 4)

    def warnings(self, size: tuple[int, int], camera: CameraIntrinsics | None) -> list[str]:
        """A sentence on each thing that can hardly be right, with what to do.

        Args:
            size: width and height of the frames.
            camera: that took them, where it is known.
        """
        return [*_of_camera(camera), *self._of_depths(size), *self._of_time()]

    def _of_depths(self, size: tuple[int, int]) -> list[str]:
        found = []
        if min(size) < _LEAST_SIDE_PX:
            found.append(f"the depth images have {size[0]}x{size[1]} pixels, too few to find a camera by")
        share, depths = self.measured_share, self.depth_m
        if self.looked_at and self.too_far > _LEAST_MEASURED * self._pixels:
            found.append(
                f"{self.too_far / self._pixels:.0%} of the pixels hold a kilometre or more and count as no "
                "return; if the numbers are millimetres, give --depth-scale 0.001"
            )
        elif share is not None and share < _LEAST_MEASURED:
            found.append(
                f"only {share:.1%} of the pixels measured a depth; is it the right topic, unit and range?"
            )
        elif self.swapped_is_smoother > 0.5 * max(self.looked_at, 1):
            found.append("the depths look as if the two bytes of each number were swapped by the recorder")
        elif depths is not None and not _USUAL_M[0] <= depths[1] <= _USUAL_M[1]:
            found.append(
                f"the depths are unusual: {depths[0]:.3g} to {depths[2]:.3g} m, median {depths[1]:.3g} m; if "
                "the unit is another, give --depth-scale (0.001 for millimetres, 0.0001 for 0.1 mm)"
            )
        if self.fixed_frame is not None:
            found.append(
                f"the clouds are in the frame {self.fixed_frame!r}, in which others move: they are looked at "
                "from its origin, where no sensor was; record the clouds of the sensor's own frame"
            )
        if self.share_in_view < _LEAST_IN_VIEW:
            found.append(
                f"only {self.share_in_view:.0%} of the first cloud's points lie in one camera's view; the "
                "others, beside it and behind it as of a lidar that looks all round, are not used"
            )
        return found

    def _of_time(self) -> list[str]:
        found = []
        if self.identical_frames > _MANY_REPEATS * self.frames:
            found.append(
                f"{self.identical_frames} of {self.frames} depth frames repeat the one before them, as a "
                "stalled driver does; the camera seems to stand still there"
            )
        if self.blank_frames:
            found.append(f"{self.blank_frames} of {self.frames} depth frames hold no depth at all, but zeros")
        if self.stamp_steps_back:
            found.append(self._step_back())
        if self.camera_changes:
            times = ", ".join(f"{seconds:.3f}" for seconds in self.camera_changes[:5])
            found.append(
                f"the camera's calibration changes {_times(len(self.camera_changes))}, at {times} s: frames "
                "are brought to the first one"
            )
        return found

    def _step_back(self) -> str:
        """Stamps that step back: of frames that were written late, or by a clock that was set."""
        count, step_s = self.stamp_steps_back, self.largest_step_back_s
        times = _times(count)
        far = "" if step_s is None else f" by up to {step_s:.3g} s"
        told = (
            f"the stamps of the depth frames step back {times}{far}, first at {self.first_step_back_s:.3f} s"
        )
        if step_s is not None and step_s <= _LATE_S:
            return (
                f"{told}: read in the order of their stamps, as is right for frames that were written late; "
                "if a clock was set there, read before and after apart with --start and --end"
            )
        return (
            f"{told}: a clock was set; frames from before and after may be mixed or left out, read them "
            "apart with --start and --end"
        )


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _of_camera(camera: CameraIntrinsics | None) -> list[str]:
    """A principal point outside the image: of a part that was cut out of a larger one, or a mistake."""
    if camera is None or (
        -0.5 <= camera.cx <= camera.width - 0.5 and -0.5 <= camera.cy <= camera.height - 0.5
    ):
        return []
    return [
        f"the principal point {camera.cx:.1f}, {camera.cy:.1f} lies outside the image of {camera.width}x"
        f"{camera.height} pixels; unless that was cut out of a larger one, give --intrinsics fx,fy,cx,cy"
    ]


def _roughness(stored: NDArray[np.uint16]) -> float:
    """Median difference of neighbours over the median of what was stored."""
    values = stored.astype(np.float32)
    both = (values[:, 1:] > 0) & (values[:, :-1] > 0)
    if np.count_nonzero(both) < stored.shape[0]:
        return 0.0
    return float(np.median(np.abs(np.diff(values, axis=1))[both]) / np.median(values[:, 1:][both]))
