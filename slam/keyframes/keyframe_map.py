"""The map: keyframe surfaces shared by all hypotheses, and which of them a camera should be compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN
from slam.keyframes.depth_view import CanvasView
from slam.keyframes.pages import Paged, PageFile
from slam.keyframes.rendering import NEAREST_DEPTH_M
from slam.keyframes.surfels import SurfelImage

Tree = TypeVar("Tree")

SAMPLED_STRIDE_PX = 8
"""Overlap is judged on a lattice of this stride: some 300 points a keyframe."""

COVER_ROWS, COVER_COLUMNS = 6, 8
"""Cells of the image in which coverage by keyframes is counted. Chosen by hand."""

NEAREST_CANDIDATES = 64
"""Keyframes considered for selection: search effort."""

LEAST_OVERLAP = 0.08
"""Share of a keyframe's points that the camera must see, and of the camera's that the keyframe must, for the
keyframe to be of use."""


LEAST_KNOWN = 0.5
"""Of the lattice, by which two thumbnails of depth can be compared."""


@dataclass(frozen=True, kw_only=True)
class KeyframeMap:
    """Keyframe surfaces in the order of their creation. Poses belong to the hypotheses, not to the map.

    Attributes:
        surfaces: one per keyframe.
        samples: (300, 3) points of each keyframe in its own frame, NaN where it has none; overlap only.
        pages: where surfaces go that have not been asked for for long.
    """

    surfaces: tuple[Paged[SurfelImage], ...] = ()
    samples: tuple[NDArray[np.float32], ...] = ()
    pages: PageFile = field(default_factory=PageFile, compare=False, repr=False)

    def __len__(self) -> int:
        return len(self.surfaces)

    def surface(self, index: int) -> SurfelImage:
        """Of one keyframe."""
        return self.surfaces[index].value

    def with_keyframe(self, surface: SurfelImage) -> KeyframeMap:
        """The map with one keyframe more."""
        samples = (*self.samples, sample_points(surface))
        held = self.pages.hold(surface.committed())
        return replace(self, surfaces=(*self.surfaces, held), samples=samples)

    def with_refined(self, index: int, surface: SurfelImage) -> KeyframeMap:
        """The map with the surface of one keyframe replaced by a better one."""
        held = self.pages.hold(surface.committed())
        return replace(self, surfaces=(*self.surfaces[:index], held, *self.surfaces[index + 1 :]))

    def only(self, chosen: Sequence[int]) -> KeyframeMap:
        """The map of some of its keyframes."""
        return replace(
            self,
            surfaces=tuple(self.surfaces[index] for index in chosen),
            samples=tuple(self.samples[index] for index in chosen),
        )

    def stacked(self, indices: NDArray[np.int_]) -> SurfelImage:
        """The surfaces of (M,) keyframes, leaves stacked (M, ...)."""
        return stacked(*(self.surface(int(index)) for index in indices))


@jax.jit
def stacked(*trees: Tree) -> Tree:
    """Trees of one kind as one, leaves stacked; leaf by leaf it takes longer than it is worth (measured)."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


_SAMPLED = (..., *2 * (slice(SAMPLED_STRIDE_PX // 2, None, SAMPLED_STRIDE_PX),))


def sample_points(view: CanvasView | SurfelImage) -> NDArray[np.float32]:
    """Points (S, 3) of a view in its camera's frame, on the lattice; NaN where there is no depth."""
    depth = np.asarray(view.depth_m)[_SAMPLED].reshape(-1, 1)
    points = np.asarray(view.rays)[_SAMPLED].reshape(3, -1).T * depth
    return np.where(depth > NO_RETURN, points, np.nan).astype(np.float32)


def visible_cells(
    samples: NDArray[np.float32], camera_from_keyframes: NDArray[np.float64], intrinsics: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Share (N,) of each keyframe's points inside the camera's image, and the image cells (N, C) they hit.

    Args:
        samples: (N, S, 3), NaN where unknown.
        camera_from_keyframes: (N, 4, 4).
        intrinsics: (6,) fx, fy, cx, cy, columns, rows of the camera at working resolution.
    """
    fx, fy, cx, cy, columns, rows = intrinsics
    rotation, translation = camera_from_keyframes[:, :3, :3], camera_from_keyframes[:, :3, 3]
    points = np.einsum("nij,nsj->nsi", rotation, samples) + translation[:, None]
    known = np.isfinite(points[..., 2])
    ahead = known & (points[..., 2] > NEAREST_DEPTH_M)
    depth = np.where(ahead, points[..., 2], 1.0)
    u = (fx * np.nan_to_num(points[..., 0]) / depth + cx + 0.5) / columns
    v = (fy * np.nan_to_num(points[..., 1]) / depth + cy + 0.5) / rows
    inside = ahead & (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
    share = inside.sum(1) / np.maximum(known.sum(1), 1)
    cell = (v * COVER_ROWS).astype(int) * COVER_COLUMNS + (u * COVER_COLUMNS).astype(int)
    hit = np.zeros((len(samples), COVER_ROWS * COVER_COLUMNS), bool)
    keyframe, point = np.nonzero(inside)
    hit[keyframe, cell[keyframe, point]] = True
    return share, hit


def place_distances(samples: NDArray[np.float32], depth_m: NDArray[np.float32]) -> NDArray[np.float64]:
    """Median absolute log ratios (N,) of thumbnails of depth, keyframes' samples (N, S, 3), to another (S,).

    NaN stands for no depth; inf where less than half of the lattice is known in both.
    """
    known = np.isfinite(samples[..., 2]) & np.isfinite(depth_m)
    ratios = np.abs(np.log(np.where(known, samples[..., 2], 1.0) / np.where(known, depth_m, 1.0)))
    median = np.median(np.where(known, ratios, np.inf), axis=1)
    return np.where(known.mean(axis=1) >= LEAST_KNOWN, median, np.inf).astype(np.float64)


def selected_keyframes(
    samples: Sequence[NDArray[np.float32]],
    reference_from_keyframes: NDArray[np.float64],
    seen: NDArray[np.float32],
    reference_from_camera: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    count: int,
) -> NDArray[np.int_]:
    """Indices (<= count,) of the keyframes to compare a camera with; the first is the closest view.

    Views overlap as far as each has the other's points in its image: a camera far behind a keyframe has all
    of that one's, and shows next to nothing of what it saw. After the closest view, each keyframe is the one
    that covers most of what is still uncovered; among equals the oldest, which anchors. Where none overlaps
    it is the nearest camera's.

    Args:
        samples: of the keyframes, as in `KeyframeMap`.
        reference_from_keyframes: (N, 4, 4).
        seen: (S, 3) the same of the camera.
        reference_from_camera: (4, 4).
        intrinsics: (6,) of all, as in `visible_cells`.
        count: at most so many.
    """
    distance = np.linalg.norm(reference_from_keyframes[:, :3, 3] - reference_from_camera[:3, 3], axis=1)
    near = np.sort(np.argsort(distance, kind="stable")[:NEAREST_CANDIDATES])
    placed = reference_from_keyframes[near]
    camera_from_keyframes = np.linalg.inv(reference_from_camera) @ placed
    keyframes_from_camera = np.linalg.inv(placed) @ reference_from_camera
    share, hit = visible_cells(np.stack([samples[i] for i in near]), camera_from_keyframes, intrinsics)
    seen = np.broadcast_to(seen, (len(near), *seen.shape))
    back, _ = visible_cells(seen, keyframes_from_camera, intrinsics)
    share = np.minimum(share, back)
    usable = share >= LEAST_OVERLAP
    chosen = [int(np.argmax(share) if usable.any() else np.argmin(distance[near]))]
    covered = hit[chosen[0]].copy()
    usable[chosen[0]] = False
    while len(chosen) < count and usable.any():
        gain = np.where(usable, (hit & ~covered).sum(1) + 0.25 * hit.sum(1), -1.0)
        best = int(np.argmax(gain))
        chosen.append(best)
        covered |= hit[best]
        usable[best] = False
    return near[chosen]
