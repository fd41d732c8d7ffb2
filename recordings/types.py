"""What a depth camera recorded: the values that every stage shares.

Metres, radians, integer nanoseconds. Poses are named `target_from_source`. Camera frames look along
+z with x to the right and y down (ROS optical, OpenCV); pixel centres are integers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recordings.settings import check_finite, check_within

NO_RETURN = 0.0
"""Value of a depth pixel that measured nothing: zero, negative, NaN, infinite or saturated in the source."""


@dataclass(frozen=True, kw_only=True)
class CameraIntrinsics:
    """Pinhole intrinsics in pixels: u = fx x / z + cx, v = fy y / z + cy, pixel centres at integers.

    Raises:
        ValueError: a size is not positive or a parameter is not finite.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise ValueError(f"image size must be positive, got {self.width}x{self.height}")
        if not (np.isfinite([self.fx, self.fy, self.cx, self.cy]).all() and self.fx > 0 < self.fy):
            raise ValueError(
                "focal lengths must be positive and the principal point finite, got "
                f"fx={self.fx} fy={self.fy} cx={self.cx} cy={self.cy}"
            )

    def rays(self, columns: ArrayLike, rows: ArrayLike) -> NDArray[np.float64]:
        """Directions (..., 3) in the camera frame through pixels that broadcast, scaled to z = 1."""
        x = (np.asarray(columns) - self.cx) / self.fx
        y = (np.asarray(rows) - self.cy) / self.fy
        return np.stack(np.broadcast_arrays(x, y, 1.0), axis=-1)

    def resized(self, width: int, height: int) -> CameraIntrinsics:
        """Intrinsics of the same view sampled at another size: cx' = (cx + 0.5) s - 0.5."""
        scale_x, scale_y = width / self.width, height / self.height
        return CameraIntrinsics(
            width=width,
            height=height,
            fx=self.fx * scale_x,
            fy=self.fy * scale_y,
            cx=(self.cx + 0.5) * scale_x - 0.5,
            cy=(self.cy + 0.5) * scale_y - 0.5,
        )


_SHARES = ("outlier_probability", "none_hit_probability", "none_miss_probability")


@dataclass(frozen=True, kw_only=True)
class DepthNoise:
    """Parameters of the one sensor density (docs/model.md, section 0); `shapes.depth_noise` evaluates it.

    The standard deviation is sigma(z) = sigma_base_m + sigma_growth_per_m (z - 0.4 m)^2. The
    defaults are those of structured light.

    Attributes:
        sigma_base_m: standard deviation at 0.4 m.
        sigma_growth_per_m: growth of the standard deviation with squared distance, in 1/m.
        outlier_probability: share of returns that are uniform over the range.
        none_hit_probability: share of pixels without a return where the ray meets a surface.
        none_miss_probability: the same where the ray meets nothing.
        max_range_m: D, the far end of the uniform part.

    Raises:
        ValueError: a value is not finite, or out of its range.
    """

    sigma_base_m: float = 0.0012
    sigma_growth_per_m: float = 0.0019
    outlier_probability: float = 0.01
    none_hit_probability: float = 0.05
    none_miss_probability: float = 0.95
    max_range_m: float = 10.0

    def __post_init__(self) -> None:
        if not any(isinstance(value, float) for value in vars(self).values()):
            return  # traced by JAX, or axes of its transformations
        check_finite(self)
        check_within(self, 1e-6, 1.0, ("sigma_base_m",))
        check_within(self, 0.0, 10.0, ("sigma_growth_per_m",))
        check_within(self, 0.0, 1.0, _SHARES)
        check_within(self, 1e-3, 1e4, ("max_range_m",))


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One depth image, with the colour image that is registered to it where there is one.

    Attributes:
        time_ns: the sensor's own stamp, not the time of logging.
        depth_m: (H, W) float32, distance along the optical axis; `NO_RETURN` where none was measured.
        rgb: (H, W, 3) uint8 or None.
        rgb_known: (H, W) pixels whose colour another camera saw, where colour is projected from there; None
            where all are known.
    """

    time_ns: int
    depth_m: NDArray[np.float32]
    rgb: NDArray[np.uint8] | None = None
    rgb_known: NDArray[np.bool_] | None = None


@dataclass(frozen=True, kw_only=True)
class Damage:
    """What could not be read from a recording.

    Attributes:
        lost_messages: messages known to be missing or unreadable, on any topic.
        lost_chunks: chunks that failed their checksum, did not decompress or were cut off.
        verified: True if every byte that was used stood under a checksum that held.
    """

    lost_messages: int = 0
    lost_chunks: int = 0
    verified: bool = True

    def __bool__(self) -> bool:
        return self.lost_messages > 0 or self.lost_chunks > 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """Camera poses at sensor times.

    Attributes:
        times_ns: (T,) int64, increasing.
        reference_from_camera: (T, 4, 4) float64 rigid transforms, orthonormal.
    """

    times_ns: NDArray[np.int64]
    reference_from_camera: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.times_ns)

    @property
    def moves(self) -> bool:
        """Whether its poses differ."""
        return bool((self.reference_from_camera != self.reference_from_camera[:1]).any())
