"""A learned shape: its surface in the room, and its voxels by probability in a space of their own."""

from __future__ import annotations

import numpy as np
import rerun as rr

from shapes.prior import ShapePrior

SHOWN = 0.5
"""Voxels at least as probable are drawn."""
SURFACE_COLOUR = (205, 210, 220)


def log_shape(recording: rr.RecordingStream, name: str, shape: ShapePrior) -> None:
    """The surface where the shape was learned, the seen voxels under `shapes/NAME`; nothing without any."""
    pose = shape.reference_from_grid
    path = f"world/shapes/{name}"
    recording.log(path, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), static=True)
    if not (shape.enclosed | (shape.phi > SHOWN)).any():
        return
    surface = shape.surface()
    mesh = rr.Mesh3D(
        vertex_positions=surface.vertices_m,
        triangle_indices=surface.triangles,
        vertex_colors=surface.rgb,
        albedo_factor=None if surface.rgb is not None else SURFACE_COLOUR,
    )
    recording.log(path, mesh, static=True)
    shown = shape.seen_occupied & (shape.phi >= SHOWN)
    voxels = rr.VoxelGridMap(
        np.argwhere(shown).astype(np.int32),
        voxel_size=[shape.pitch_m] * 3,
        values=shape.phi[shown],
        value_range=[SHOWN, 1.0],
        colormap=rr.components.Colormap.Viridis,
    )
    recording.log(f"shapes/{name}", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    recording.log(f"shapes/{name}/voxels", voxels, static=True)
