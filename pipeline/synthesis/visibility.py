"""Which pixels of an image an object covers, and which of them it shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.synthesis.world import Part, RayCaster
from recordings.types import CameraIntrinsics

Box = tuple[int, int, int, int]
"""Column, row, width, height in pixels, as BOP writes it."""
NO_BOX: Box = (-1, -1, -1, -1)
"""BOP's box of nothing."""


@dataclass(frozen=True, eq=False)
class Silhouette:
    """The pixels that a part would cover if nothing hid it and the image were large enough.

    Attributes:
        mask: (h, w) bool in a window that holds all of them.
        left: column of the window in the image; may be negative.
        top: its row.
    """

    mask: NDArray[np.bool_]
    left: int
    top: int

    @property
    def pixels(self) -> int:
        """How many there are."""
        return int(self.mask.sum())

    @property
    def box(self) -> Box:
        """Their bounding box in the image's coordinates."""
        left, top, width, height = bounding_box(self.mask)
        return (left + self.left, top + self.top, width, height) if width > 0 else NO_BOX

    def in_image(self, width: int, height: int) -> NDArray[np.bool_]:
        """Those of them (height, width) that lie in the image."""
        image = np.zeros((height, width), bool)
        rows, columns = np.nonzero(self.mask)
        rows, columns = rows + self.top, columns + self.left
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        image[rows[inside], columns[inside]] = True
        return image


@dataclass(frozen=True)
class PixelCounts:
    """Pixels of one part in one view.

    Attributes:
        whole: of its silhouette in an image large enough to hold it.
        inside: of those in the image.
        shown: of those not hidden by another part.
    """

    whole: int
    inside: int
    shown: int

    @property
    def visible_fraction(self) -> float:
        """Share of the silhouette that the image shows."""
        return self.shown / self.whole if self.whole else 0.0


def bounding_box(mask: NDArray[np.bool_]) -> Box:
    """Bounding box of the set pixels of an image, `NO_BOX` where there is none."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return NO_BOX
    left, top = int(columns[0]), int(rows[0])
    return left, top, int(columns[-1]) - left + 1, int(rows[-1]) - top + 1


def silhouette(
    part: Part, intrinsics: CameraIntrinsics, world_from_camera: NDArray[np.float64]
) -> Silhouette:
    """The silhouette of a part; empty where it stands wholly or partly behind the camera."""
    camera_from_part = np.linalg.inv(world_from_camera) @ part.world_from_part
    points = trimesh.transform_points(part.mesh.vertices, camera_from_part)
    if points[:, 2].min() <= 0:
        return Silhouette(np.zeros((1, 1), bool), 0, 0)
    u = intrinsics.fx * points[:, 0] / points[:, 2] + intrinsics.cx
    v = intrinsics.fy * points[:, 1] / points[:, 2] + intrinsics.cy
    left, top = int(np.floor(u.min())), int(np.floor(v.min()))
    window = CameraIntrinsics(
        width=int(np.ceil(u.max())) - left + 1,
        height=int(np.ceil(v.max())) - top + 1,
        fx=intrinsics.fx,
        fy=intrinsics.fy,
        cx=intrinsics.cx - left,
        cy=intrinsics.cy - top,
    )
    return Silhouette(np.isfinite(RayCaster([part]).view(window, world_from_camera).depth_m), left, top)


def pixel_counts(alone: Silhouette, shown: NDArray[np.bool_]) -> PixelCounts:
    """Pixels of a part with that silhouette of which an image shows those set in `shown` (H, W)."""
    height, width = shown.shape
    return PixelCounts(
        whole=alone.pixels,
        inside=int(alone.in_image(width, height).sum()),
        shown=int(shown.sum()) if alone.pixels else 0,
    )
