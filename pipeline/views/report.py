"""The run in words: one Markdown page beside the pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.publishing.values import RunValues
from pipeline.surfaces import Surfaces
from pipeline.views.trajectory_view import ENLARGED
from scene.result import SceneResult


def report_markdown(name: str, values: RunValues) -> str:
    """What was found, how sure it is, and how to read the views."""
    parts = [f"# {name}"]
    if values.scene is not None and values.surfaces is not None:
        parts += _scene(values.scene, values.surfaces)
    if values.slam is not None:
        slam = values.slam
        deviation_mm = 1000 * np.sqrt(np.trace(slam.covariance[:, :3, :3], axis1=1, axis2=2) / 3)
        lost = int(slam.lost.sum())
        length_m = np.linalg.norm(np.diff(slam.mean[:, :3, 3], axis=0), axis=1).sum()
        parts += [
            "## Camera",
            f"- {len(slam)} frames over {length_m:.2f} m, {lost or 'none'} lost",
            f"- position known to {np.median(deviation_mm):.2g} mm (median standard deviation an axis), "
            f"{deviation_mm.max():.2g} mm at worst",
            f"- least effective sample size {slam.ess.min():.1f} of {len(slam.log_weights)} particles",
            *_paths(slam.path_probabilities),
            f"- yellow: mean path; faint: particles; blue: 95% regions, drawn {ENLARGED:.0f} times larger",
        ]
    if values.shapes:
        parts += ["## Learned shapes", "| shape | size, mm | pitch, mm | seen voxels |", "|---|---|---|---|"]
    for shape_name, shape in values.shapes.items():
        extents = np.ptp(shape.bounding_box_m, axis=0) if shape.solid.any() else ()
        size = " x ".join(f"{1000 * extent:.0f}" for extent in extents) or "nothing solid"
        seen = int(shape.seen_occupied.sum())
        parts.append(f"| {shape_name} | {size} | {1000 * shape.pitch_m:.0f} | {seen} |")
    return "\n".join(parts) + "\n"


def _paths(probabilities: NDArray[np.float64]) -> list[str]:
    """One line where several paths explain what was seen."""
    if len(probabilities) == 1:
        return []
    told = ", ".join(f"{probability:.0%}" for probability in probabilities)
    return [
        f"- **{len(probabilities)} paths explain what was seen**, with {told}; the mean is the likeliest's"
    ]


def _scene(scene: SceneResult, surfaces: Surfaces) -> list[str]:
    """One line for each object looked for; positions are those of its middle."""
    names = [*map(str, scene.names), *scene.supports]
    lines = [
        "## Objects",
        "| object | there | mm | deg | rests on |",
        "|---|---|---|---|---|",
    ]
    for one, name in enumerate(scene.names):
        if not scene.found[one]:
            lines.append(f"| {name} | {scene.presence[one]:.0%} | | | not found |")
            continue
        parent = int(np.argmax(scene.edge_probabilities[one]))
        probability = scene.edge_probabilities[one, parent]
        rest = f"{names[parent]} ({probability:.0%})" if probability > 0 else "nothing"
        middle = surfaces.by_name[str(name)].middle_m
        spread_mm = 1000 * np.sqrt(np.trace(scene.covariance_of_point(one, middle)))
        lines.append(
            f"| {name} | {scene.presence[one]:.0%} | +- {spread_mm:.1f} "
            f"| +- {np.degrees(scene.rotation_std_rad[one]):.1f} | {rest} |"
        )
    return [
        *lines,
        "- mm, deg: root mean square error expected of its middle and of its orientation",
        f"- wire ellipsoids: 95% regions of positions, drawn {ENLARGED:.0f} times larger",
    ]
