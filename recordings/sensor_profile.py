"""What is known of one depth sensor: how its depths err alike in every frame.

Real depth cameras err by a static field over the image, 1/z_measured = 1/z + d(u, v). The field is given at
`NODE_ROWS` x `NODE_COLUMNS` nodes, evenly from edge to edge of the image, and between them by the bicubic
spline through the nodes (natural at the edges). Its mean is next to the sensor's scale, which nothing in a
recording tells, and is taken as zero.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recordings.errors import RecordingError
from recordings.types import NO_RETURN, CameraIntrinsics

FORMAT_VERSION = 1
"""Of the file."""

NODE_ROWS, NODE_COLUMNS = 7, 9
"""The field is smooth: 63 nodes that were learnt on half of a recording took 36 to 41% of the variance of the
residuals off another one (the 7-Scenes kitchen)."""

PRIOR_SD_PER_M = 2e-3
"""Standard deviation of a node before a sensor is known: 1.9e-3 in the 7-Scenes kitchen, 8 mm at 2 m."""

LARGEST_PER_M = 0.1
"""At 2 m that is an error of 40 cm: no depth sensor is as bad."""


def node_weights(fractions: ArrayLike, nodes: int) -> NDArray[np.float64]:
    """Weights (..., nodes) of the natural cubic spline through even nodes at places (...) within 0..1."""
    place = np.clip(np.asarray(fractions, np.float64), 0.0, 1.0) * (nodes - 1)
    first = np.minimum(place.astype(int), nodes - 2)
    after = (place - first)[..., None]
    before = 1.0 - after
    values, bends = np.eye(nodes), np.zeros((nodes, nodes))
    inner = 4.0 * np.eye(nodes - 2) + np.eye(nodes - 2, k=1) + np.eye(nodes - 2, k=-1)
    bends[1:-1] = np.linalg.solve(inner, 6.0 * np.diff(values, 2, axis=0))
    bent = (before**3 - before) * bends[first] + (after**3 - after) * bends[first + 1]
    return before * values[first] + after * values[first + 1] + bent / 6.0


def pixel_weights(width: int, height: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights (height, `NODE_ROWS`) of an image's rows and (width, `NODE_COLUMNS`) of its columns."""
    rows = node_weights((np.arange(height) + 0.5) / height, NODE_ROWS)
    return rows, node_weights((np.arange(width) + 0.5) / width, NODE_COLUMNS)


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorProfile:
    """One sensor's distortion field, as far as it is known.

    Attributes:
        intrinsics: of the images that it was learnt from.
        disparity_per_m: (`NODE_ROWS`, `NODE_COLUMNS`) d at the nodes, 1/m.
        sd_per_m: alike, its standard deviation.

    Raises:
        ValueError: an array has another shape, or a value that is not possible.
    """

    intrinsics: CameraIntrinsics
    disparity_per_m: NDArray[np.float64]
    sd_per_m: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name in ("disparity_per_m", "sd_per_m"):
            values = getattr(self, name)
            if values.shape != (NODE_ROWS, NODE_COLUMNS):
                raise ValueError(f"{name} needs {NODE_ROWS} rows of {NODE_COLUMNS} numbers")
            if not (np.abs(values) <= LARGEST_PER_M).all():
                raise ValueError(f"{name} must lie within {LARGEST_PER_M:g}, got {np.abs(values).max():g}")
        if not (self.sd_per_m > 0).all():
            raise ValueError(f"sd_per_m must be positive, got {self.sd_per_m.min():g}")

    def corrected(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """A depth image (H, W) as a sensor without the distortion would have measured it."""
        rows, columns = pixel_weights(depth_m.shape[1], depth_m.shape[0])
        shrink = 1.0 - (rows @ self.disparity_per_m @ columns.T) * depth_m
        known = (depth_m != NO_RETURN) & (shrink > 0)
        return np.where(known, depth_m / np.where(known, shrink, 1.0), NO_RETURN).astype(np.float32)

    def table(self) -> dict[str, Any]:
        """What its TOML file says."""
        return {
            "format_version": FORMAT_VERSION,
            "image": vars(self.intrinsics),
            "distortion": {
                "disparity_per_m": self.disparity_per_m.tolist(),
                "sd_per_m": self.sd_per_m.tolist(),
            },
        }


def read_sensor_profile(path: Path, intrinsics: CameraIntrinsics) -> SensorProfile:
    """The profile in a file, of the sensor that takes images with these intrinsics.

    Raises:
        RecordingError: the file cannot be read, says something impossible, or is of another camera.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        if table.get("format_version") != FORMAT_VERSION:
            raise ValueError(f"format_version is not {FORMAT_VERSION}")
        fields = {name: np.asarray(rows, np.float64) for name, rows in table["distortion"].items()}
        profile = SensorProfile(intrinsics=CameraIntrinsics(**table["image"]), **fields)
    except OSError as error:
        raise RecordingError(f"cannot read the sensor profile {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordingError(f"{path} is no sensor profile: {error}") from error
    if not _same_view(profile.intrinsics, intrinsics):
        raise RecordingError(
            f"{path} is the profile of another camera: {_named(profile.intrinsics)}, "
            f"the recording's is {_named(intrinsics)}"
        )
    return profile


SAME_VIEW = 0.02
"""Share of the image by which two cameras' focal lengths and centres may differ: a tenth of a node's step."""


def _same_view(one: CameraIntrinsics, other: CameraIntrinsics) -> bool:
    """Whether two cameras see the same field of view, whatever the number of pixels."""
    alike = one.resized(other.width, other.height)
    sides = np.asarray([other.width, other.height, other.width, other.height])
    differences = [getattr(alike, name) - getattr(other, name) for name in ("fx", "fy", "cx", "cy")]
    return bool((np.abs(differences) <= SAME_VIEW * sides).all())


def _named(camera: CameraIntrinsics) -> str:
    return f"{camera.width}x{camera.height} with fx {camera.fx:g}, cx {camera.cx:g}, cy {camera.cy:g}"
