"""How thick walls thinner than a voxel are drawn, and which voxels a surface touches at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.benchmarks.shape_films import ObjectFilm
from pipeline.evaluation.inside import lies_inside
from pipeline.evaluation.shapes import intersection_over_union
from pipeline.export.meshes import as_trimesh
from pipeline.synthesis.world import Part, RayCaster
from shapes.prior import ShapePrior
from shapes.voxel_grid import VoxelGrid

WALL_FIGURES = ("wall_mm", "true_wall_mm", "walls_drawn")
SAMPLES = 4000
"""Points of the true surface: a thickness of 1 mm with a spread of as much is known to 0.03 mm."""
FEWEST = 40
"""Samples on thin walls seen from both sides below which there is no figure."""
STEEPEST_COSINE = 0.25
"""Between a view's ray and the surface it shows, as in learning."""
SPACING = 0.25
"""Of points by which a surface touches voxels, in voxels."""
NUDGE_M = 1e-5
"""Off the surface, so that a ray that starts there does not meet it at once."""


@dataclass(frozen=True, kw_only=True)
class DrawnWalls:
    """Walls of an object thinner than a voxel of which some view sees both sides.

    Attributes:
        share: of the object's surface that they make up.
        true_m: their median thickness, None where there are too few.
        drawn_m: that of the learned surface there, None likewise.
        drawn_share: share of them where there is a learned wall at all.
    """

    share: float
    true_m: float | None = None
    drawn_m: float | None = None
    drawn_share: float | None = None


def wall_figures(
    film: ObjectFilm, reference_from_mesh: NDArray[np.float64], learned: ShapePrior, grid: VoxelGrid
) -> dict[str, float | None]:
    """The figures of a row: agreement of touched voxels, and thin walls in millimetres.

    Args:
        film: of the true shape.
        reference_from_mesh: (4, 4) where it is in the learned shape's reference frame.
        learned: the shape.
        grid: voxels that hold both shapes.
    """
    surface = as_trimesh(learned.surface())
    walls = drawn_walls(
        film.mesh,
        surface,
        np.linalg.inv(reference_from_mesh) @ learned.reference_from_grid,
        np.linalg.inv(film.reference_from_mesh) @ film.trajectory,
        learned.pitch_m,
    )
    grid_from_reference = np.linalg.inv(grid.reference_from_grid)
    touched = (
        touched_voxels(grid, surface, grid_from_reference @ learned.reference_from_grid),
        touched_voxels(grid, film.mesh, grid_from_reference @ reference_from_mesh),
    )
    millimetres = (None if size is None else 1000 * size for size in (walls.drawn_m, walls.true_m))
    figures = dict(zip(WALL_FIGURES, (*millimetres, walls.drawn_share), strict=True))
    return {"touched": intersection_over_union(*touched), **figures}


def drawn_walls(
    mesh: trimesh.Trimesh,
    learned: trimesh.Trimesh,
    mesh_from_learned: NDArray[np.float64],
    mesh_from_camera: NDArray[np.float64],
    pitch_m: float,
) -> DrawnWalls:
    """Measure a learned surface across the walls of the true one.

    Args:
        mesh: the true shape.
        learned: its learned surface, closed.
        mesh_from_learned: (4, 4).
        mesh_from_camera: (T, 4, 4) true poses of the views.
        pitch_m: walls thinner than that are measured.
    """
    caster = RayCaster([Part(name="object", mesh=mesh, world_from_part=np.eye(4))])
    points, faces = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)[:2]
    points, outward = np.asarray(points), mesh.face_normals[np.asarray(faces)]
    across = caster.cast(points - NUDGE_M * outward, -outward)
    thickness = across.distance.astype(np.float64) + NUDGE_M
    chosen = thickness < pitch_m
    backs = points - np.where(chosen, thickness, 0.0)[:, None] * outward
    turned = np.sign((across.normal * outward).sum(axis=1))[:, None]
    chosen &= _is_seen(caster, points, outward, mesh_from_camera)
    chosen &= _is_seen(caster, backs, -turned * across.normal, mesh_from_camera)
    if chosen.sum() < FEWEST:
        return DrawnWalls(share=float(chosen.mean()))
    points, outward = points[chosen], outward[chosen]
    found = RayCaster([Part(name="learned", mesh=learned, world_from_part=mesh_from_learned)])
    starts = points + pitch_m * outward
    depth = found.cast(starts, -outward).distance.astype(np.float64)
    near = depth < 2 * pitch_m
    behind = starts[near] - (depth[near, None] + NUDGE_M) * outward[near]
    drawn = found.cast(behind, -outward[near]).distance + NUDGE_M
    return DrawnWalls(
        share=float(chosen.mean()),
        true_m=float(np.median(thickness[chosen])),
        drawn_m=float(np.median(drawn)) if near.any() else None,
        drawn_share=float(near.mean()),
    )


def _is_seen(
    caster: RayCaster,
    points: NDArray[np.float64],
    outward: NDArray[np.floating],
    mesh_from_camera: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Whether some view sees points (N, 3) of the surface, not too slantingly."""
    seen = np.zeros(len(points), np.bool_)
    for eye in mesh_from_camera[:, :3, 3]:
        way = points + NUDGE_M * outward - eye
        length = np.linalg.norm(way, axis=1)
        ray = way / length[:, None]
        free = caster.cast(eye, ray).distance > length - NUDGE_M
        seen |= free & (-(ray * outward).sum(axis=1) > STEEPEST_COSINE)
    return seen


def touched_voxels(
    grid: VoxelGrid, mesh: trimesh.Trimesh, grid_from_mesh: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Voxels (I, J, K) that a mesh fills or its surface touches, to a quarter of a voxel."""
    placed = mesh.copy().apply_transform(grid_from_mesh)
    touched = lies_inside(placed, grid.centres_m)
    vertices, faces = trimesh.remesh.subdivide_to_size(
        placed.vertices, placed.faces, SPACING * grid.pitch_m, max_iter=20
    )[:2]
    places = np.concatenate([vertices, vertices[faces].mean(axis=1)]) / grid.pitch_m
    index = np.floor(places).astype(np.intp)
    index = index[np.all((index >= 0) & (index < grid.shape), axis=1)]
    touched[np.ravel_multi_index(tuple(index.T), grid.shape)] = True
    return touched.reshape(grid.shape)
