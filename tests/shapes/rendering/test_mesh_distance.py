"""Which side of a mesh's surface the voxels of a grid are on."""

import numpy as np
import trimesh

from shapes.rendering.mesh_distance import nearest_sheets


def test_what_is_open_is_outside_though_its_brim_is_next_to_the_border() -> None:
    """A cup with three quarters of a voxel round it, as an object has at the coarsest level of detail.

    The voxels over its brim are as near as those on it: they part its inside from the grid's corners.
    """
    margin, size = 0.75, np.array([18, 18, 19])
    profile = np.array([[0, 0], [8.25, 0], [8.25, 17.5], [7.65, 17.5], [7.65, 1], [0, 1]])
    cup = trimesh.creation.revolve(profile, sections=64)

    sheets = nearest_sheets(cup.vertices - cup.bounds[0] + margin, cup.faces, tuple(size.tolist()))

    assert (sheets.distance[9, 9, 3:] > 0).all()
