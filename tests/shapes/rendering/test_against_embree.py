"""Rendered depth pixel by pixel against Embree on the same mesh, and how it changes as the object moves."""

from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recordings.types import CameraIntrinsics
from shapes.rendering.depth_rendering import render_layers
from shapes.rendering.object_library import library_of_mesh
from tests.shapes.views import cameras, posed, ray_cast

DISTANCE_M = 0.8
CAMERA = CameraIntrinsics(width=200, height=200, fx=533.0, fy=533.5, cx=99.7, cy=100.2)
SHIFT_M = 2e-5
VOXELS = 2**18
"""Of a bounding box, as `parse` takes."""


def sphere(wall_m: float) -> trimesh.Trimesh:
    """A hollow sphere of 10 cm."""
    inner = trimesh.creation.icosphere(4, 0.05 - wall_m)
    inner.invert()
    outer = trimesh.creation.icosphere(4, 0.05)
    return cast("trimesh.Trimesh", trimesh.util.concatenate([outer, inner]))


def cup(wall_m: float) -> trimesh.Trimesh:
    """The same sphere, open at the top."""
    arc = np.linspace(0.0, 2.0, 32)
    profile = [[r * np.sin(arc), -r * np.cos(arc)] for r in (0.05, 0.05 - wall_m)]
    outer, inner = (np.stack(each, axis=1) for each in profile)
    return trimesh.creation.revolve(np.concatenate([outer, inner[::-1]]), sections=96)


def compared(mesh: trimesh.Trimesh, views: int) -> tuple[float, float, float, float]:
    """Shares of pixels off by > 2 mm and wrongly in or out; pixels a view that jump, here and by Embree."""
    rng = np.random.default_rng(5)
    poses = np.tile(np.eye(4), (views, 1, 1))
    poses[:, :3, :3] = Rotation.random(views, rng=rng).as_matrix()
    poses[:, :3, 3] = [0, 0, DISTANCE_M] - poses[:, :3, :3] @ mesh.bounds.mean(axis=0)
    moved = poses.copy()
    step = rng.normal(size=(views, 3))
    moved[:, :3, 3] += SHIFT_M * step / np.linalg.norm(step, axis=1, keepdims=True)
    pitch_m = (np.prod(mesh.extents) / VOXELS) ** (1 / 3)
    library = library_of_mesh(mesh.vertices, mesh.faces, pitch_m)
    ours, ours_moved = (
        np.asarray(render_layers(library, posed(each), cameras(CAMERA), CAMERA.height, CAMERA.width))
        for each in (poses, moved)
    )
    truth, truth_moved = (ray_cast(mesh, each, CAMERA) for each in (poses, moved))
    area = np.isfinite(truth).sum()
    both = np.isfinite(ours) & np.isfinite(truth)
    off = (np.abs(ours[both] - truth[both]) > 0.002).sum() / area
    outline = (np.isfinite(ours) != np.isfinite(truth)).sum() / area
    return off, outline, jumps(ours, ours_moved) / views, jumps(truth, truth_moved) / views


def jumps(before: NDArray[np.floating], after: NDArray[np.floating]) -> int:
    """Pixels whose depth changes by more than 3 mm, or that come or go."""
    before, after = (np.where(np.isfinite(depth), depth, 10.0) for depth in (before, after))
    return int((np.abs(before - after) > 0.003).sum())


def ycb(folder: Path) -> Iterator[tuple[str, trimesh.Trimesh]]:
    """The 21 meshes."""
    for path in sorted(folder.glob("*.ply")):
        yield path.stem, cast("trimesh.Trimesh", trimesh.load(path, process=False))


@pytest.mark.parametrize("wall_mm", [0.5, 2.0])
@pytest.mark.parametrize("shape", [sphere, cup])
def test_walls_thinner_than_a_voxel_are_where_they_are(shape, wall_mm: float) -> None:
    """Voxels of 1.4 mm: with one plane a voxel up to 6% of the cup's pixels were off and 3.4% in or out."""
    off, outline, _, _ = compared(shape(wall_mm / 1000), 6)

    assert off < 0.01
    assert outline < 0.015


@pytest.mark.slow
def test_the_21_ycb_shapes_render_as_by_embree(shared_data: Path) -> None:
    """24 views each; one plane a voxel put up to 10.6% off, 5% in or out, and had 6.7 times the jumps.

    Measured: 0.69%, 1.09%, 1.20 times.
    """
    rows = {name: compared(mesh, 24) for name, mesh in ycb(shared_data / "ycbv" / "models")}

    table = np.array(list(rows.values()))
    assert table[:, 0].max() < 0.01, rows
    assert table[:, 1].max() < 0.015, rows
    assert table[:, 2].sum() < 1.5 * table[:, 3].sum(), rows
