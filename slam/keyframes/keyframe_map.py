"""The map: keyframe surfaces shared by all particles, and which of them a camera should be compared with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from slam.keyframes.surfels import SurfelImage

Tree = TypeVar("Tree")

SAMPLED_STRIDE_PX = 8
"""Overlap is judged on a lattice of this stride: some 300 points a keyframe."""

COVER_ROWS, COVER_COLUMNS = 6, 8
"""Cells of the image in which coverage by keyframes is counted. Chosen by hand."""

NEAREST_CANDIDATES = 64
"""Keyframes considered for selection: search effort."""

LEAST_OVERLAP = 0.08
"""Share of a keyframe's points that the camera must see for the keyframe to be of use."""


@dataclass(frozen=True, kw_only=True)
class KeyframeMap:
    """Keyframe surfaces in the order of their creation. Poses belong to the particles, not to the map.

    Attributes:
        surfaces: one per keyframe.
        samples: (300, 3) points of each keyframe in its own frame, NaN where it has none; overlap only.
    """

    surfaces: tuple[SurfelImage, ...] = ()
    samples: tuple[NDArray[np.float32], ...] = ()

    def __len__(self) -> int:
        return len(self.surfaces)

    def with_keyframe(self, surface: SurfelImage) -> KeyframeMap:
        """The map with one keyframe more."""
        return KeyframeMap(
            surfaces=(*self.surfaces, surface), samples=(*self.samples, _sample_points(surface))
        )

    def with_refined(self, index: int, surface: SurfelImage) -> KeyframeMap:
        """The map with the surface of one keyframe replaced by a better one."""
        surfaces = (*self.surfaces[:index], surface, *self.surfaces[index + 1 :])
        return KeyframeMap(surfaces=surfaces, samples=self.samples)

    def stacked(self, indices: NDArray[np.int_]) -> SurfelImage:
        """The surfaces of (M,) keyframes, leaves stacked (M, ...)."""
        return stacked(*(self.surfaces[i] for i in indices))


@jax.jit
def stacked(*trees: Tree) -> Tree:
    """Trees of one kind as one, leaves stacked; leaf by leaf it takes longer than it is worth (measured)."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def _sample_points(surface: SurfelImage) -> NDArray[np.float32]:
    every = slice(SAMPLED_STRIDE_PX // 2, None, SAMPLED_STRIDE_PX)
    points = np.asarray(surface.points())[:, every, every].reshape(3, -1).T
    return np.where(points[:, 2:] > 0, points, np.nan).astype(np.float32)


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
    ahead = known & (points[..., 2] > 0.05)
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


def selected_keyframes(
    keyframe_map: KeyframeMap,
    reference_from_keyframes: NDArray[np.float64],
    reference_from_camera: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    count: int,
) -> NDArray[np.int_]:
    """Indices (<= count,) of the keyframes to compare a camera with; the first is the closest view.

    After the closest view, each keyframe is the one that covers most of what is still uncovered; among
    equals the oldest, which anchors.
    """
    distance = np.linalg.norm(reference_from_keyframes[:, :3, 3] - reference_from_camera[:3, 3], axis=1)
    near = np.sort(np.argsort(distance, kind="stable")[:NEAREST_CANDIDATES])
    camera_from_keyframes = np.linalg.inv(reference_from_camera) @ reference_from_keyframes[near]
    samples = np.stack([keyframe_map.samples[i] for i in near])
    share, hit = visible_cells(samples, camera_from_keyframes, intrinsics)
    usable = share >= LEAST_OVERLAP
    chosen = [int(np.argmax(share))]
    covered = hit[chosen[0]].copy()
    usable[chosen[0]] = False
    while len(chosen) < count and usable.any():
        gain = np.where(usable, (hit & ~covered).sum(1) + 0.25 * hit.sum(1), -1.0)
        best = int(np.argmax(gain))
        chosen.append(best)
        covered |= hit[best]
        usable[best] = False
    return near[chosen]
