"""What a user may say about a recording that the file does not say, or not rightly."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from recordings.settings import check_finite

LARGEST_PX = 1e4
"""Of focal lengths and principal points."""


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """How a recording is read.

    Attributes:
        depth_topic: which depth images are meant, where there are several.
        intrinsics: fx, fy, cx, cy in pixels of the stored images, instead of the recorded ones.
        depth_scale_m: metres for a stored depth of 1, instead of 0.001 for integers and 1 for floats.
        min_depth_m: nearer depths count as no return.
        max_depth_m: farther depths count as no return.
        mask: an image of the size of the depth images, black where they see what moves with the camera;
            these pixels count as no return.
        colour_alone: frames of the first colour topic will do where there is no depth.
        sensor: a sensor profile, by whose distortion field depths are corrected.
        start_s: seconds after the first frame from which frames are read.
        end_s: seconds after the first frame up to which, inclusive, frames are read.
        every: of those frames, the first and every so many-th after it.

    Raises:
        ValueError: a value is not possible; the message names it.
    """

    depth_topic: str | None = None
    intrinsics: tuple[float, float, float, float] | None = None
    depth_scale_m: float | None = None
    min_depth_m: float = 0.0
    max_depth_m: float = math.inf
    mask: Path | None = None
    colour_alone: bool = False
    sensor: Path | None = None
    start_s: float = 0.0
    end_s: float = math.inf
    every: int = 1

    def __post_init__(self) -> None:
        check_finite(self, unbounded=("max_depth_m", "end_s"))
        if self.intrinsics is not None:
            if len(self.intrinsics) != 4:
                raise ValueError(f"intrinsics are four numbers, fx, fy, cx, cy, got {self.intrinsics}")
            fx, fy, cx, cy = self.intrinsics
            if not (all(abs(value) < LARGEST_PX for value in self.intrinsics) and fx > 0 < fy):
                raise ValueError(f"intrinsics need pixels with fx, fy > 0, got {fx:g},{fy:g},{cx:g},{cy:g}")
        if self.depth_scale_m is not None and not 0 < self.depth_scale_m <= 1:
            raise ValueError(
                f"depth scale is metres for a stored 1, above 0 and at most 1, got {self.depth_scale_m:g}; "
                "for a divisor such as 5000 give 1/5000 = 0.0002"
            )
        if not 0 <= self.min_depth_m < self.max_depth_m:
            raise ValueError(f"depths need 0 <= min < max, got {self.min_depth_m:g} to {self.max_depth_m:g}")
        if not 0 <= self.start_s <= self.end_s:
            raise ValueError(f"times need 0 <= start <= end, got {self.start_s:g} to {self.end_s:g}")
        if self.every < 1:
            raise ValueError(f"every must be at least 1, got {self.every}")
