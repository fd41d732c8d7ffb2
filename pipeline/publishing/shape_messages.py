"""A learned shape in run.mcap: voxels with colours, and the surface by what was seen of it."""

from __future__ import annotations

import numpy as np
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.VoxelGrid_pb2 import VoxelGrid
from numpy.typing import NDArray

from pipeline.colours import INFERRED, SEEN, UNSEEN
from pipeline.publishing.foxglove_geometry import (
    COLOUR_FIELDS,
    REFERENCE,
    add_metadata,
    add_triangles,
    packed_fields,
    set_packed_colour,
    set_pose,
)
from shapes.prior import ShapePrior, SurfaceState, VoxelState

STATE_COLOURS = {SurfaceState.NEVER_SEEN: UNSEEN, SurfaceState.INFERRED: INFERRED, SurfaceState.SEEN: SEEN}
OPACITY = {
    VoxelState.UNSEEN: 0,
    VoxelState.SEEN_FREE: 0,
    VoxelState.SEEN_OCCUPIED: 255,
    VoxelState.ENCLOSED: 110,
}
"""Of voxels, of 255: what is known to be there, and what closes it behind."""


def voxel_grid(shape: ShapePrior) -> VoxelGrid:
    """Probability, kind (`VoxelState`) and colour of each voxel, x fastest as Foxglove stores them."""
    columns, rows, slices = shape.phi.shape
    fields = [("phi", "<f4"), ("seen", "u1"), *((name, "u1") for name in COLOUR_FIELDS)]
    packed = np.zeros((slices, rows, columns), fields)
    states = shape.voxel_states.transpose(2, 1, 0)
    packed["phi"] = shape.phi.transpose(2, 1, 0)
    packed["seen"] = states
    colours = _voxel_colours(states) if shape.rgb is None else shape.rgb.transpose(2, 1, 0, 3)
    set_packed_colour(packed, colours, np.array([OPACITY[state] for state in VoxelState])[states])
    grid = VoxelGrid(
        frame_id=REFERENCE,
        row_count=rows,
        column_count=columns,
        cell_stride=packed.itemsize,
        row_stride=packed.itemsize * columns,
        slice_stride=packed.itemsize * columns * rows,
        data=packed.tobytes(),
    )
    grid.cell_size.x = grid.cell_size.y = grid.cell_size.z = shape.pitch_m
    set_pose(grid.pose, shape.reference_from_grid)
    grid.fields.extend(packed_fields(packed.dtype))
    return grid


def surface_update(name: str, shape: ShapePrior) -> SceneUpdate:
    """The surface where the shape stood, each vertex in the colour of its state."""
    surface = shape.surface()
    update = SceneUpdate()
    entity = update.entities.add(frame_id=REFERENCE, id=f"{name} surface")
    colours = surface_colours(shape.surface_states(surface))
    add_triangles(entity, shape.reference_from_grid, surface.vertices_m, surface.triangles, colours)
    shares = shape.surface_shares(surface)
    add_metadata(entity, {state.name.lower(): f"{share:.0%}" for state, share in shares.items()})
    return update


def surface_colours(states: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(N, 3) of states (N,) of `SurfaceState`."""
    return np.array([STATE_COLOURS[state] for state in SurfaceState], np.uint8)[states]


def _voxel_colours(states: NDArray[np.uint8]) -> NDArray[np.uint8]:
    inferred = (states == VoxelState.ENCLOSED)[..., None]
    return np.where(inferred, np.array(INFERRED, np.uint8), np.array(SEEN, np.uint8))
