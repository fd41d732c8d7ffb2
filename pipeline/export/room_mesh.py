"""The room as coloured triangles: all depth frames fused along a run's trajectory.

Truncated signed distances (Curless and Levoy 1996) in Open3D's hashed voxel blocks; the colours are means
of what the colour images show where their depth is at the surface.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import open3d as o3d
import trimesh
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.room import UNSEEN_GREY
from recordings.types import CameraIntrinsics, Frame
from shapes.learning.colouring import ColourSums

PITCH_M = 0.01
TRUNCATION_PITCHES = 4.0
"""Distances are kept so far from the surface: Open3D's default is 8, which fills gaps between thin things."""
FEWEST_VIEWS, FEWEST_OF_USUAL = 3.0, 0.5
"""Surface that fewer frames saw is left out, as Open3D does by default: it is mostly noise at edges. Where
frames are few and far apart one or two see most surfaces: half of what usually sees one will then do."""
SAMPLED_BLOCKS = 1000
"""Blocks of voxels, spread evenly, that tell how many frames usually see a surface."""
FARTHEST_M = 6.0
"""Beyond this a structured-light sensor's noise (`DepthNoise`) exceeds five centimetres."""
MOST_FRAMES = 1000
"""Of longer recordings so many frames, spread evenly: more only repeat what is seen."""
COLOURED_FRAMES = 100
BLOCK = 16
"""Voxels along the edge of a block, Open3D's own choice."""

Posed = tuple[Frame, NDArray[np.float64]]


def room_mesh(
    frames: Callable[[], Iterable[Posed]],
    intrinsics: CameraIntrinsics,
    *,
    pitch_m: float = PITCH_M,
    progress: Callable[[int], None] | None = None,
) -> trimesh.Trimesh:
    """Fuse frames into a mesh, open where nothing was seen.

    Args:
        frames: gives the frames with their poses reference_from_camera (4, 4), the same ones at each call.
        intrinsics: of their camera.
        pitch_m: edge of a voxel.
        progress: is told how many frames are fused.

    Raises:
        PipelineError: too little was seen for a surface.
    """
    grid = _Grid(intrinsics, pitch_m)
    for count, (frame, pose) in enumerate(frames(), start=1):
        grid.add(frame.depth_m, pose)
        if progress:
            progress(count)
    vertices, triangles = grid.surface()
    if not len(triangles):
        raise PipelineError("the frames show too little for a surface; track more, or try a larger --pitch")
    colours = ColourSums(vertices, at_surface_m=2 * pitch_m)
    for frame, pose in _thinned(frames, COLOURED_FRAMES):
        colours.add(frame, intrinsics, pose)
    rgb, known = colours.means()
    rgb[~known] = UNSEEN_GREY
    return trimesh.Trimesh(vertices, triangles, vertex_colors=rgb if known.any() else None, process=False)


class _Grid:
    """Signed distances in hashed blocks of voxels."""

    def __init__(self, intrinsics: CameraIntrinsics, pitch_m: float) -> None:
        self._voxels = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight"),
            (o3d.core.float32, o3d.core.float32),
            ((1,), (1,)),  # pyright: ignore[reportArgumentType]
            voxel_size=pitch_m,
            block_resolution=BLOCK,
            block_count=10_000,
        )
        self._empty = True
        # Open3D looks up the pixel below a projection: its pixel centres lie at halves.
        matrix = [[intrinsics.fx, 0, intrinsics.cx + 0.5], [0, intrinsics.fy, intrinsics.cy + 0.5], [0, 0, 1]]
        self._camera = _tensor(np.asarray(matrix, np.float64))

    def add(self, depth_m: NDArray[np.float32], reference_from_camera: NDArray[np.float64]) -> None:
        """Take in one depth image (H, W); one that shows nothing near enough changes nothing."""
        if not ((depth_m > 0) & (depth_m < FARTHEST_M)).any():  # Open3D raises where it has no block to touch
            return
        self._empty = False
        depth = o3d.t.geometry.Image(_tensor(depth_m))
        camera_from_reference = _tensor(np.linalg.inv(reference_from_camera))
        settings = (1.0, FARTHEST_M, TRUNCATION_PITCHES)  # metres for a stored 1
        blocks = self._voxels.compute_unique_block_coordinates(
            depth, self._camera, camera_from_reference, *settings
        )
        if len(blocks):
            self._voxels.integrate(blocks, depth, self._camera, camera_from_reference, *settings)

    def surface(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Vertices (V, 3) in metres and triangles (F, 3) of the zero level."""
        if self._empty:
            return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
        try:
            mesh = self._voxels.extract_triangle_mesh(weight_threshold=self._fewest_views())
        except RuntimeError:  # Open3D raises where no voxel was seen often enough
            return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
        if mesh.is_empty():
            return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
        return (
            mesh.vertex.positions.numpy().astype(np.float64),
            mesh.triangle.indices.numpy().astype(np.int64),
        )

    def _fewest_views(self) -> float:
        """How many frames have to see a surface."""
        blocks = self._voxels.hashmap().active_buf_indices().to(o3d.core.int64)
        some = blocks[:: -(-len(blocks) // SAMPLED_BLOCKS)]
        distances, weights = (self._voxels.attribute(name)[some].numpy() for name in ("tsdf", "weight"))
        near = weights[(weights > 0) & (np.abs(distances) < 1 / TRUNCATION_PITCHES)]
        return min(FEWEST_VIEWS, FEWEST_OF_USUAL * float(np.median(near))) if near.size else FEWEST_VIEWS


def _thinned(frames: Callable[[], Iterable[Posed]], count: int) -> Iterator[Posed]:
    """At most so many of the frames that have colour, spread evenly."""
    coloured = sum(frame.rgb is not None for frame, _ in frames())
    step = max(1, -(-coloured // count))
    with_colour = (one for one in frames() if one[0].rgb is not None)
    return (one for number, one in enumerate(with_colour) if number % step == 0)


def _tensor(values: NDArray[Any]) -> o3d.core.Tensor:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values))
