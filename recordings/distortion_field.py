"""A sensor's static distortion: inverse depths err by a field over the image, 1/z_measured = 1/z + d(u, v).

The field is given at `NODE_ROWS` x `NODE_COLUMNS` nodes, evenly from edge to edge of the image, and between
them by the bicubic spline through the nodes (natural at the edges). Its mean is next to the sensor's scale,
which nothing in a recording tells, and is taken as zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recordings.types import NO_RETURN

NODE_ROWS, NODE_COLUMNS = 7, 9
"""The field is smooth: 63 nodes that were learnt on half of a recording took 36 to 41% of the variance of the
residuals off another one (the 7-Scenes kitchen)."""

PRIOR_SD_PER_M = 2e-3
"""Standard deviation of a node before a sensor is known: 1.9e-3 in the 7-Scenes kitchen, 8 mm at 2 m."""

LARGEST_PER_M = 0.1
"""At 2 m that is an error of 40 cm: no depth sensor is as bad."""

_LEAST_SHRINK = 0.5
"""Of the measured depth over the corrected one; a field of four times `PRIOR_SD_PER_M` gives 0.92 at 10 m.
What would more than double is beyond what any field was learnt on, and a little farther at infinity."""


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
class DistortionField:
    """The field, as far as it is known.

    Attributes:
        disparity_per_m: (`NODE_ROWS`, `NODE_COLUMNS`) d at the nodes, 1/m.
        sd_per_m: alike, its standard deviation.

    Raises:
        ValueError: an array has another shape, or a value that is not possible.
    """

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
        """A depth image (H, W) as a sensor without the distortion would have measured it.

        `NO_RETURN` where depths are so far beyond what the field corrects that they would more than double.
        """
        rows, columns = pixel_weights(depth_m.shape[1], depth_m.shape[0])
        shrink = 1.0 - (rows @ self.disparity_per_m @ columns.T) * depth_m
        known = (depth_m != NO_RETURN) & (shrink >= _LEAST_SHRINK)
        return np.where(known, depth_m / np.where(known, shrink, 1.0), NO_RETURN).astype(np.float32)
