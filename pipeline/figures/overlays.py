"""Outlines of posed objects on the image that shows them; edges that something hides are dotted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from skimage.measure import find_contours

from pipeline.report.pictures import depth_pixels
from pipeline.synthesis.world import Part, RayCaster
from recordings.types import CameraIntrinsics, Frame

HIDDEN_M = 0.015
"""What is measured so much nearer than an outlined surface hides it."""
LINE_PX = 2.0
MARGIN = 0.3
"""Of the crop round the outlines, as a share of their size."""
LEAST_CROP_PX = 80


@dataclass(frozen=True, kw_only=True, eq=False)
class Outline:
    """One posed surface.

    Attributes:
        mesh: in metres in its own frame.
        camera_from_mesh: (4, 4).
        colour: as matplotlib names it.
        label: what it is, in the legend; the same label is listed once.
    """

    mesh: trimesh.Trimesh
    camera_from_mesh: NDArray[np.float64]
    colour: str
    label: str


def picture_of(frame: Frame) -> NDArray[np.uint8]:
    """The frame's colours (H, W, 3), or its depth as colours, nearer brighter."""
    return depth_pixels(frame.depth_m).astype(np.uint8) if frame.rgb is None else frame.rgb


def draw_overlay(
    axis: Any,
    frame: Frame,
    intrinsics: CameraIntrinsics,
    outlines: Sequence[Outline],
    *,
    crop: bool = True,
) -> None:
    """Draw a frame with outlines on one of matplotlib's axes.

    Args:
        axis: where to.
        frame: what was seen.
        intrinsics: of its camera.
        outlines: later ones are drawn over earlier ones.
        crop: show what is round the outlines, else the whole image.
    """
    axis.imshow(picture_of(frame))
    boxes, labelled = [], set[str]()
    for one in outlines:
        part = Part(name=one.label, mesh=one.mesh, world_from_part=one.camera_from_mesh)
        depth = RayCaster([part]).view(intrinsics, np.eye(4)).depth_m
        covered = np.isfinite(depth)
        if not covered.any():
            continue
        rows, columns = np.nonzero(covered)
        boxes.append((columns.min(), rows.min(), columns.max(), rows.max()))
        hidden = covered & (frame.depth_m > 0) & (frame.depth_m < depth - HIDDEN_M)
        label = one.label if one.label not in labelled else None
        labelled.add(one.label)
        _draw_contours(axis, covered, hidden, one.colour, label)
    if crop and boxes:
        _crop(axis, np.array(boxes), intrinsics)
    axis.set_axis_off()


def _draw_contours(
    axis: Any, covered: NDArray[np.bool_], hidden: NDArray[np.bool_], colour: str, label: str | None
) -> None:
    """The border of a mask, solid where it is seen and dotted where it is hidden."""
    width = LINE_PX * 72 / axis.figure.dpi
    for contour in find_contours(np.pad(covered, 1).astype(np.float64), 0.5):
        points = contour - 1
        inner = np.clip(np.round(points).astype(int), 0, np.array(covered.shape) - 1)
        behind = _near(hidden)[inner[:, 0], inner[:, 1]]
        for style, chosen in (("-", ~behind), (":", behind)):
            line = np.where(chosen[:, None], points, np.nan)
            axis.plot(line[:, 1], line[:, 0], style, color=colour, lw=width, label=label)
            label = None


def _near(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A mask and its neighbouring pixels."""
    wide = np.pad(mask, 1)
    height, width = mask.shape
    return np.logical_or.reduce(
        [wide[row : row + height, column : column + width] for row in range(3) for column in range(3)]
    )


def _crop(axis: Any, boxes: NDArray[np.int64], intrinsics: CameraIntrinsics) -> None:
    low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    middle = (low + high) / 2
    half = max((high - low).max() * (0.5 + MARGIN), LEAST_CROP_PX / 2)
    left, right = max(middle[0] - half, -0.5), min(middle[0] + half, intrinsics.width - 0.5)
    top, bottom = max(middle[1] - half, -0.5), min(middle[1] + half, intrinsics.height - 0.5)
    axis.set(xlim=(left, right), ylim=(bottom, top))
