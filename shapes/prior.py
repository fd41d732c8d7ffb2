"""The learned shape: a probability of occupancy for every voxel, and what was seen of it.

The variational family of 3DP3, supplement I, equation 2: independent Bernoulli voxels; and, finer than these,
Gaussian surfels beside them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from shapes.archive import load_arrays, save_arrays
from shapes.surface import SurfaceMesh, level_surface
from shapes.surfels import Surfels
from shapes.voxel_grid import VoxelGrid

FORMAT_VERSION = 2
"""Of the file."""
READABLE_VERSIONS = 1, 2
"""The first one has no surfels."""

MEDIAN = 0.5
"""The level at which inside is as likely as outside."""
PITCHES_M = 1e-4, 1.0
"""Voxels of a tenth of a millimetre to a metre: below, or above, the unit is another."""

LARGEST_BYTES = 1 << 30
"""Of all arrays of a shape: 500 voxels along each edge, with colour. No object needs more."""


class VoxelState(IntEnum):
    """What is known of a voxel: the masks of `ShapePrior` as one number."""

    UNSEEN = 0
    SEEN_FREE = 1
    SEEN_OCCUPIED = 2
    ENCLOSED = 3


class SurfaceState(IntEnum):
    """What is known of a place on the surface of a shape.

    SEEN: between a voxel seen free and one seen occupied, or where surfels place it. NEVER_SEEN:
    neither of the two voxels was seen, as below an object that stood on a table. INFERRED: one of them was;
    the surface closes the shape behind what was seen.
    """

    NEVER_SEEN = 0
    INFERRED = 1
    SEEN = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class ShapePrior:
    """Independent occupancy probabilities on a voxel grid, whose frame is the object's frame.

    The centre of voxel (i, j, k) is ((i, j, k) + 0.5) pitch in the grid frame. Where the object stood on
    a plane, the k axis is the plane's normal and layer k = 0 starts on the plane. The three masks are
    disjoint; a voxel in none of them was never seen and keeps the prior.

    Attributes:
        phi: (I, J, K) float32, p(occupied) of each voxel.
        pitch_m: edge of a voxel.
        reference_from_grid: (4, 4) float64 rigid, grid frame to the run's reference frame.
        seen_free: (I, J, K) bool, some ray reached the voxel and it is more likely free.
        seen_occupied: (I, J, K) bool, some ray reached the voxel and it is more likely occupied.
        enclosed: (I, J, K) bool, hidden behind seen surface in every view that had it in its image.
        rgb: (I, J, K, 3) uint8, colour of the nearest seen surface voxel, or None without colour images.
        surfels: pieces of surface beside the voxels, two at a wall that was seen from both sides.

    Raises:
        ValueError: shapes disagree, a probability is outside [0, 1], masks overlap, or the pose is not rigid.
    """

    phi: NDArray[np.float32]
    pitch_m: float
    reference_from_grid: NDArray[np.float64]
    seen_free: NDArray[np.bool_]
    seen_occupied: NDArray[np.bool_]
    enclosed: NDArray[np.bool_]
    rgb: NDArray[np.uint8] | None = None
    surfels: Surfels = field(default_factory=Surfels.none)

    def __post_init__(self) -> None:
        if self.phi.ndim != 3 or self.phi.size == 0:
            raise ValueError(f"phi has shape {self.phi.shape}, expected (I, J, K)")
        low, high = PITCHES_M
        if not low <= self.pitch_m <= high:
            raise ValueError(f"pitch_m is {self.pitch_m}, expected {low:g} to {high:g} metres")
        if not (np.isfinite(self.phi).all() and self.phi.min() >= 0 and self.phi.max() <= 1):
            raise ValueError("phi has values outside [0, 1]")
        masks = (self.seen_free, self.seen_occupied, self.enclosed)
        if any(mask.shape != self.phi.shape or mask.dtype != np.bool_ for mask in masks):
            raise ValueError(f"seen_free, seen_occupied and enclosed must be bool {self.phi.shape}")
        if np.add.reduce(masks, dtype=np.uint8).max() > 1:
            raise ValueError("a voxel is in two of seen_free, seen_occupied and enclosed")
        if self.rgb is not None and (self.rgb.shape != (*self.phi.shape, 3) or self.rgb.dtype != np.uint8):
            raise ValueError(f"rgb must be uint8 {(*self.phi.shape, 3)}")
        pose = self.reference_from_grid
        rigid = pose.shape == (4, 4) and np.isfinite(pose).all() and np.array_equal(pose[3], [0, 0, 0, 1])
        rigid = rigid and np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)
        if not (rigid and np.linalg.det(pose[:3, :3]) > 0):
            raise ValueError("reference_from_grid is not a rigid 4x4 transform")
        if len(self.surfels) and not 0 <= self.surfels.voxel[0] <= self.surfels.voxel[-1] < self.phi.size:
            raise ValueError("a surfel's voxel is not in the grid")

    @property
    def grid(self) -> VoxelGrid:
        """Where the voxels are; whether a plane ends rays at z = 0 is not kept."""
        i, j, k = self.phi.shape
        return VoxelGrid(
            shape=(i, j, k),
            pitch_m=self.pitch_m,
            reference_from_grid=self.reference_from_grid,
            on_plane=False,
        )

    @property
    def solid(self) -> NDArray[np.bool_]:
        """Voxels of the solid object (I, J, K): seen occupied, or enclosed and so decided by mask."""
        return self.seen_occupied | self.enclosed

    @property
    def voxel_states(self) -> NDArray[np.uint8]:
        """(I, J, K) of `VoxelState`."""
        states = VoxelState.SEEN_FREE * self.seen_free + VoxelState.SEEN_OCCUPIED * self.seen_occupied
        return (states + VoxelState.ENCLOSED * self.enclosed).astype(np.uint8)

    def surface_states(self, surface: SurfaceMesh) -> NDArray[np.uint8]:
        """(N,) of `SurfaceState` of the vertices of one of this shape's surfaces."""
        states = np.pad(self.voxel_states, 1)
        inner = states[tuple(surface.inner.T + 1)]
        outer = states[tuple(surface.outer.T + 1)]
        touched = inner == VoxelState.SEEN_OCCUPIED
        passed = outer == VoxelState.SEEN_FREE
        told = (SurfaceState.INFERRED * touched + SurfaceState.INFERRED * passed).astype(np.uint8)
        return np.where(np.isfinite(surface.sigma_m), np.uint8(SurfaceState.SEEN), told)

    def surface_shares(self, surface: SurfaceMesh) -> dict[SurfaceState, float]:
        """Shares of the area of one of this shape's surfaces, by what is known of it."""
        corners = surface.vertices_m[surface.triangles]
        doubled = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        states = self.surface_states(surface)[surface.triangles]
        return {
            state: float((doubled * (states == state).mean(axis=1)).sum() / doubled.sum())
            for state in SurfaceState
        }

    @property
    def has_surface(self) -> bool:
        """Whether any voxel lies inside of `surface` at one half."""
        return bool((self.enclosed | (self.phi > 0.5)).any())

    @property
    def bounding_box_m(self) -> NDArray[np.float64]:
        """Lowest and highest corner (2, 3) of the solid voxels in the grid frame.

        Raises:
            ValueError: no voxel is solid.
        """
        occupied = np.argwhere(self.solid)
        if len(occupied) == 0:
            raise ValueError("no voxel is solid: there is no bounding box")
        return np.stack([occupied.min(axis=0), occupied.max(axis=0) + 1]) * self.pitch_m

    def sample(self, key: jax.Array, count: int) -> jax.Array:
        """Binary shapes (count, I, J, K) drawn voxel by voxel with probability phi."""
        return jax.random.bernoulli(key, jnp.asarray(self.phi)[None], (count, *self.phi.shape))

    def seen_part(self, surface: SurfaceMesh) -> SurfaceMesh:
        """One of this shape's surfaces without what closes it behind and below: open where nothing was seen.

        The triangles that are left have their inner side in voxels that were seen, or lie where surfels do.
        """
        seen = self.seen_occupied[tuple(surface.inner.T)] | np.isfinite(surface.sigma_m)
        return replace(surface, triangles=surface.triangles[seen[surface.triangles].all(axis=1)])

    def surface(self, level: float = MEDIAN) -> SurfaceMesh:
        """Closed surface where the probability crosses `level`, enclosed voxels filled, in the grid frame.

        Where surfels are known to a quarter of a voxel they place it, both sides of thin walls too. Voxels
        that were never seen take part only where the level is below their prior.

        Raises:
            ValueError: no voxel lies above the level.
        """
        return self._median_surface if level == MEDIAN else self._surface_at(level)

    @cached_property
    def _median_surface(self) -> SurfaceMesh:
        """The one that summaries, messages, views and exports all ask for; with surfels it takes seconds."""
        return self._surface_at(MEDIAN)

    def _surface_at(self, level: float) -> SurfaceMesh:
        filled = np.where(self.enclosed, np.float32(1.0), self.phi)
        return level_surface(filled, level, self.pitch_m, self.rgb, self.surfels)

    def save(self, path: str | Path) -> None:
        """Write the npz file that `load` reads; its names are a contract (format_version 2).

        Raises:
            OSError: the folder cannot be written.
        """
        arrays = {
            "format_version": np.int64(FORMAT_VERSION),
            "phi": self.phi,
            "pitch_m": np.float64(self.pitch_m),
            "reference_from_grid": self.reference_from_grid,
            "seen_free": self.seen_free,
            "seen_occupied": self.seen_occupied,
            "enclosed": self.enclosed,
            **self.surfels.arrays,
        }
        save_arrays(path, arrays if self.rgb is None else arrays | {"rgb": self.rgb})

    @classmethod
    def load(cls, path: str | Path) -> ShapePrior:
        """Read a shape.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is damaged, of another format, or holds values that are no shape.
        """
        arrays = load_arrays(path, largest_bytes=LARGEST_BYTES)
        version = arrays.pop("format_version", None)
        if version is None or version.shape != () or version not in READABLE_VERSIONS:
            found = "none" if version is None else version
            readable = " and ".join(map(str, READABLE_VERSIONS))
            raise ValueError(f"{path} has format_version {found}, this program reads {readable}")
        try:
            return cls(
                phi=arrays["phi"].astype(np.float32, copy=False),
                pitch_m=float(arrays["pitch_m"]),
                reference_from_grid=arrays["reference_from_grid"].astype(np.float64, copy=False),
                seen_free=arrays["seen_free"],
                seen_occupied=arrays["seen_occupied"],
                enclosed=arrays["enclosed"],
                rgb=arrays.get("rgb"),
                surfels=Surfels.of_arrays(arrays),
            )
        except KeyError as error:
            raise ValueError(f"{path} is not a learned shape: it has no array {error}") from error
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path} is not a learned shape: {error}") from error
