"""Thickness of drawn walls and touched voxels, on boxes whose answers are known."""

import numpy as np
import pytest
import trimesh

from pipeline.benchmarks.shape_walls import drawn_walls, touched_voxels
from shapes.voxel_grid import VoxelGrid

SHEET = trimesh.creation.box((0.1, 0.08, 0.002))


def cameras(*eyes: tuple[float, float, float]) -> np.ndarray:
    """Poses at these places; where they look does not matter here."""
    poses = np.tile(np.eye(4), (len(eyes), 1, 1))
    poses[:, :3, 3] = eyes
    return poses


def test_a_wall_is_measured_where_both_its_sides_are_seen() -> None:
    """A sheet of 2 mm that was learned as one of 3, a little off, seen from both sides and from one."""
    learned = trimesh.creation.box((0.1, 0.08, 0.003))
    aside = np.eye(4)
    aside[2, 3] = 0.0007
    above, below = (0.01, 0.0, 0.4), (0.0, 0.02, -0.4)

    found = drawn_walls(SHEET, learned, aside, cameras(above, below), 0.005)

    assert found.true_m == pytest.approx(0.002, abs=1e-5)
    assert found.drawn_m == pytest.approx(0.003, abs=1e-5)
    assert found.share > 0.9
    assert found.drawn_share == pytest.approx(1.0, abs=0.02)
    assert drawn_walls(SHEET, learned, aside, cameras(above), 0.005).drawn_m is None
    half = trimesh.creation.box((0.05, 0.08, 0.003))
    assert drawn_walls(SHEET, half, aside, cameras(above, below), 0.005).drawn_share == pytest.approx(
        0.5, abs=0.05
    )


def test_voxels_are_touched_by_a_sheet_that_holds_no_centre_of_one() -> None:
    """2 mm between the centres of two layers of 5 mm: it fills none, and touches one layer."""
    grid = VoxelGrid(shape=(30, 30, 6), pitch_m=0.005, reference_from_grid=np.eye(4), on_plane=False)
    placed = np.eye(4)
    placed[:3, 3] = 0.0751, 0.0751, 0.0162

    touched = touched_voxels(grid, SHEET, placed)

    assert touched[5:25, 7:23, 3].all()
    assert touched.sum() == touched[..., 3].sum() == 21 * 17
