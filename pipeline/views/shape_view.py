"""A learned shape: its surface by what was seen of it, and its voxels by probability and by state."""

from __future__ import annotations

import numpy as np
import rerun as rr
from scipy.ndimage import binary_dilation

from pipeline.colours import UNSEEN
from pipeline.publishing.shape_messages import surface_colours
from shapes.prior import ShapePrior, VoxelState

SHOWN = 0.5
"""Voxels at least as probable are drawn."""
MOST_UNSEEN = 100_000
"""Voxels never seen that are drawn at most, evenly chosen."""


def log_shape(recording: rr.RecordingStream, name: str, shape: ShapePrior) -> None:
    """The surface where the shape was learned; under `shapes/NAME` that and its voxels; nothing if empty."""
    if not shape.has_surface:
        return
    pose = shape.reference_from_grid
    path = f"world/shapes/{name}"
    surface = shape.surface()
    states = surface_colours(shape.surface_states(surface))
    recording.log(path, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), static=True)
    recording.log(f"shapes/{name}", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for entity, colours in (
        (f"{path}/surface", states if surface.rgb is None else surface.rgb),
        (f"shapes/{name}/surface_by_state", states),
    ):
        mesh = rr.Mesh3D(
            vertex_positions=surface.vertices_m, triangle_indices=surface.triangles, vertex_colors=colours
        )
        recording.log(entity, mesh, static=True)
    shown = shape.seen_occupied & (shape.phi >= SHOWN)
    voxels = rr.VoxelGridMap(
        np.argwhere(shown).astype(np.int32),
        voxel_size=[shape.pitch_m] * 3,
        values=shape.phi[shown],
        value_range=[SHOWN, 1.0],
        colormap=rr.components.Colormap.Viridis,
    )
    recording.log(f"shapes/{name}/voxels", voxels, static=True)
    _log_unseen(recording, name, shape)


def _log_unseen(recording: rr.RecordingStream, name: str, shape: ShapePrior) -> None:
    """Voxels that were never seen, where they touch what was: nobody knows what is there."""
    unseen = shape.voxel_states == VoxelState.UNSEEN
    shell = np.argwhere(unseen & binary_dilation(~unseen))
    shell = shell[:: -(-len(shell) // MOST_UNSEEN) or 1]
    if len(shell):
        points = rr.Points3D((shell + 0.5) * shape.pitch_m, colors=(*UNSEEN, 120), radii=0.15 * shape.pitch_m)
        recording.log(f"shapes/{name}/never_seen", points, static=True)
