"""What the camera saw of cells: a box on a table, seen at a slant."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from pipeline.synthesis.world import Part, RayCaster
from recordings.types import CameraIntrinsics
from scene.masks import grid as grid_source
from scene.masks.grid import FREE, STEPS, SeenSpace, seen_space
from scene.observation.depth_view import unproject
from scene.observation.frame_data import SceneData
from scene.observation.segmentation import scene_data

INTRINSICS = CameraIntrinsics(width=320, height=240, fx=280.0, fy=280.0, cx=159.5, cy=119.5)
EDGE_M = 0.1


@pytest.fixture(scope="module")
def data() -> SceneData:
    """A box of EDGE_M in the middle of a table, from a metre away, 45 degrees up."""
    half = np.sqrt(0.5)
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = np.array([[1, 0, 0], [0, -half, half], [0, -half, -half]])
    world_from_camera[:3, 3] = [0, -0.7, 0.7]
    below = trimesh.transformations.translation_matrix((0, 0, -0.01))
    on = trimesh.transformations.translation_matrix((0, 0, EDGE_M / 2))
    parts = [
        Part(name="table", mesh=trimesh.creation.box((1.0, 1.0, 0.02)), world_from_part=below),
        Part(name="box", mesh=trimesh.creation.box((EDGE_M,) * 3), world_from_part=on),
    ]
    depth_m = RayCaster(parts).view(INTRINSICS, world_from_camera).depth_m
    return scene_data(np.where(np.isfinite(depth_m), depth_m, 0).astype(np.float32), INTRINSICS, 0)


def seen(data: SceneData) -> SeenSpace:
    """Its cells."""
    found = seen_space(data, 0.1)
    assert found is not None
    return found


def values(space: SeenSpace, evidence: np.ndarray, data: SceneData, in_table: np.ndarray) -> np.ndarray:
    """Evidence at places (N, 3) of the table's frame round the box's foot."""
    assert data.table is not None
    place = data.table.camera_from_table[:3, :3] @ in_table.T + data.table.camera_from_table[:3, 3:]
    inside = np.linalg.inv(space.camera_from_grid) @ np.vstack([place, np.ones(len(in_table))])
    return evidence[tuple(np.floor(inside[:3] / space.pitch_m).astype(int))]


def test_surfaces_free_space_and_what_is_hidden(data: SceneData) -> None:
    """The box's top is a surface, what is over it and under the table is free, nobody saw into the box."""
    space = seen(data)
    assert data.table is not None
    points_m = unproject(data.depth_m, data.intrinsics)[data.near]
    middle = data.table.in_table_frame(points_m.mean(axis=0)) * [1, 1, 0]
    heights = np.array([-0.03, EDGE_M / 2, EDGE_M + 0.05])
    evidence = space.waiting(data.foreground).evidence

    below, within, over = values(space, evidence, data, middle + heights[:, None] * [0, 0, 1])
    top = values(space, evidence, data, middle + np.array([[0, 0, EDGE_M + dz] for dz in (-0.004, 0.004)]))

    assert (below, within, over) == (-FREE, 0, -FREE)
    assert top.max() == STEPS
    assert set(np.unique(evidence)) == {-FREE, 0, STEPS}


def test_what_is_explained_counts_nothing(data: SceneData) -> None:
    """Cells of pixels that show another object are no surface for this one, and not free either."""
    space = seen(data)
    everything, nothing = space.waiting(data.foreground), space.waiting(np.zeros_like(data.foreground))

    surface = everything.evidence == STEPS
    assert surface.sum() > 100
    assert (nothing.evidence[surface] <= 0).all()
    assert (nothing.evidence[surface] == 0).mean() > 0.99
    np.testing.assert_array_equal(nothing.evidence[~surface], everything.evidence[~surface])


def test_coarser_cells_hold_what_their_parts_show(data: SceneData) -> None:
    """A surface where a part shows one, free where all parts are."""
    grid = seen(data).waiting(data.foreground)
    coarse = grid.coarser()

    parts = np.stack([grid.evidence[i::2, j::2, k::2] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    assert coarse.pitch_m == 2 * grid.pitch_m
    np.testing.assert_array_equal(coarse.evidence == STEPS, (parts == STEPS).any(axis=0))
    np.testing.assert_array_equal(coarse.evidence == -FREE, (parts == -FREE).all(axis=0))


def test_without_a_foreground_there_is_no_grid(data: SceneData) -> None:
    """And no error."""
    nothing = replace(data, near=np.zeros_like(data.near), foreground=np.zeros_like(data.foreground))

    assert seen_space(nothing, 0.1) is None


def test_one_pixel_is_enough(data: SceneData) -> None:
    """A foreground of a single cell has a grid as large as the object."""
    rows, columns = np.nonzero(data.foreground)
    alone = np.zeros_like(data.foreground)
    alone[rows[0], columns[0]] = True
    near = np.zeros_like(data.near)
    near[tuple(np.argwhere(data.near)[0])] = True

    space = seen(replace(data, near=near, foreground=alone))

    assert (np.array(space.free.shape[:2]) * space.pitch_m >= 0.2).all()
    assert (space.waiting(alone).evidence == STEPS).sum() <= 1


def test_a_wide_grid_is_coarsened_and_told(
    data: SceneData, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """In cells that are half as large again."""
    monkeypatch.setattr(grid_source, "MOST_CELLS", seen(data).free.size - 1)
    monkeypatch.setattr(grid_source._log, "propagate", True)
    monkeypatch.setattr(grid_source._log.parent, "propagate", True)

    space = seen(data)

    assert space.pitch_m == pytest.approx(0.012)
    assert "cells of 12 mm" in caplog.text
