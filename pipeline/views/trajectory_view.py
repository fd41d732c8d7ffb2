"""The camera: its path with uncertainty, drawn trajectories, and how sure the filter was."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.colours import GREEN, LOST, ORANGE, PATH, PURPLE, SKY_BLUE
from pipeline.evaluation.trajectory_errors import largest_squared_distance
from pipeline.views.timelines import time_columns
from slam.result import SlamResult

ENLARGED = 10.0
"""Of the ellipsoids that can be switched on beside those of true size."""
ELLIPSOIDS = 40
PATH_WIDTH, THIN_WIDTH = rr.Radius.ui_points(4.0), rr.Radius.ui_points(0.7)
"""In points of the screen: a path is seen at any distance."""
PLOTS = {
    "position": ("Position std, mm", ORANGE),
    "rotation": ("Rotation std, deg", PURPLE),
    "hypotheses": ("Hypotheses, effective number", GREEN),
    "evidence": ("Log evidence, nat a frame", SKY_BLUE),
}
"""By path: title with unit, and colour. Std is the root mean square distance or angle from the mean."""


def log_trajectory(recording: rr.RecordingStream, result: SlamResult) -> None:
    """The mean path, every drawn trajectory, the 95% ellipsoids, and the camera along the frames."""
    centres = result.mean[:, :3, 3]
    path = rr.LineStrips3D([centres], colors=PATH, radii=PATH_WIDTH)
    recording.log("world/path/mean", path, static=True)
    drawn = rr.LineStrips3D(list(result.draws[:, :, 4:]), colors=(*PATH, 40), radii=THIN_WIDTH)
    recording.log("world/path/drawn", drawn, static=True)
    if result.lost.any():
        lost = rr.Points3D(centres[result.lost], colors=LOST, radii=rr.Radius.ui_points(5.0))
        recording.log("world/path/lost", lost, static=True)
    _log_ellipsoids(recording, result)
    recording.send_columns(
        "world/camera",
        indexes=time_columns(result.times_ns),
        columns=rr.Transform3D.columns(translation=centres, mat3x3=result.mean[:, :3, :3].reshape(-1, 9)),
    )


def log_filter(recording: rr.RecordingStream, result: SlamResult) -> None:
    """Spreads, number of hypotheses and log evidence over the frames."""
    series = {
        "position": 1000 * np.sqrt(np.trace(result.covariance[:, :3, :3], axis1=1, axis2=2)),
        "rotation": np.degrees(np.sqrt(np.trace(result.covariance[:, 3:, 3:], axis1=1, axis2=2))),
        "hypotheses": result.hypotheses,
        "evidence": result.log_evidence,
    }
    for path, values in series.items():
        name, colour = PLOTS[path]
        recording.log(f"plots/{path}", rr.SeriesLines(names=name, colors=colour, widths=1.5), static=True)
        columns = rr.Scalars.columns(scalars=values)
        recording.send_columns(f"plots/{path}", indexes=time_columns(result.times_ns), columns=columns)


def _log_ellipsoids(recording: rr.RecordingStream, result: SlamResult) -> None:
    """The 95% regions of some positions, of true size and ten times larger, as wires."""
    chosen = np.unique(np.linspace(0, len(result) - 1, min(ELLIPSOIDS, len(result))).round().astype(int))
    variances, axes = np.linalg.eigh(result.covariance[chosen, :3, :3])
    axes *= np.sign(np.linalg.det(axes))[:, None, None]
    turns = result.mean[chosen, :3, :3] @ axes
    radius = np.sqrt(largest_squared_distance(0.95, float(result.degrees_of_freedom), dimensions=3))
    half_sizes = radius * np.sqrt(np.maximum(variances, 0))
    for name, scale in (("uncertainty", 1.0), ("uncertainty_10x", ENLARGED)):
        ellipsoids = rr.Ellipsoids3D(
            centers=result.mean[chosen, :3, 3],
            half_sizes=scale * half_sizes,
            quaternions=quaternions_xyzw(turns),
            colors=(*SKY_BLUE, 120),
            line_radii=THIN_WIDTH,
            fill_mode="majorwireframe",
        )
        recording.log(f"world/path/{name}", ellipsoids, static=True)


def quaternions_xyzw(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rerun's quaternions (N, 4) of rotations (N, 3, 3)."""
    return Rotation.from_matrix(rotations).as_quat()
