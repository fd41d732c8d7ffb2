"""Rasterised meshes are what Embree's rays meet."""

import numpy as np
import open3d as o3d
import pytest
import trimesh

from recordings.types import CameraIntrinsics
from shapes.rendering.meshes import Mesh, MeshSet
from shapes.rendering.rasterising import Fragments, rasterise

CAMERA = CameraIntrinsics(width=60, height=40, fx=70, fy=65, cx=28.3, cy=21.1)


def mesh_set(mesh: trimesh.Trimesh) -> MeshSet:
    """Of one."""
    return MeshSet.of([Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64))])


def annulus() -> trimesh.Trimesh:
    """A short pipe: some of its inner wall is seen over its outer one."""
    return trimesh.creation.annulus(0.05, 0.1, 0.12)


def random_poses(rng: np.random.Generator, count: int) -> np.ndarray:
    """Some of them partly outside the image."""
    poses = np.stack(
        [trimesh.transformations.random_rotation_matrix(rng.uniform(size=3)) for _ in range(count)]
    )
    poses[:, :3, 3] = rng.uniform([-0.2, -0.15, 0.45], [0.2, 0.15, 0.8], (count, 3))
    return poses


def cast(mesh: trimesh.Trimesh, pose: np.ndarray, samples: int = 1) -> dict[str, np.ndarray]:
    """What Embree's rays meet, so many along each side of a pixel."""
    caster = o3d.t.geometry.RaycastingScene(nthreads=1)
    points = trimesh.transform_points(mesh.vertices, pose).astype(np.float32)
    faces = o3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32))
    caster.add_triangles(o3d.core.Tensor.from_numpy(points), faces)
    fine = (np.arange(samples) + 0.5) / samples - 0.5
    columns, rows = ((np.arange(size)[:, None] + fine).ravel() for size in (60, 40))
    directions = CAMERA.rays(columns[None], rows[:, None])
    rays = np.concatenate([np.zeros_like(directions), directions], axis=-1).astype(np.float32)
    return {
        name: values.numpy() for name, values in caster.cast_rays(o3d.core.Tensor.from_numpy(rays)).items()
    }


def test_pixels_depths_and_triangles_are_embrees(seed: int) -> None:
    """At random poses; all but pixels on an edge."""
    mesh, poses = annulus(), random_poses(np.random.default_rng(seed), 12)
    found = rasterise(mesh_set(annulus()), np.zeros(12, np.int64), poses, CAMERA)
    unlike, seen = 0, 0
    for number, pose in enumerate(poses):
        hits = cast(mesh, pose)
        expected = hits["t_hit"].ravel()
        rows = np.arange(found.start[number], found.start[number + 1])
        rows = rows[found.row[rows] * 60 + found.column[rows] == found.pixel[rows]]
        depth = np.full(expected.shape, np.inf)
        depth[found.pixel[rows]] = found.depth_m[rows]
        both = np.isfinite(depth) & np.isfinite(expected)
        seen += np.isfinite(expected).sum()
        unlike += (np.isfinite(depth) != np.isfinite(expected)).sum()
        unlike += (np.abs(depth[both] - expected[both]) > 1e-4).sum()
        theirs = hits["primitive_ids"].ravel()[found.pixel[rows]][both[found.pixel[rows]]]
        ours = found.face[rows][both[found.pixel[rows]]]
        unlike += (np.abs(mesh.face_normals[theirs] - mesh.face_normals[ours]).max(axis=1) > 1e-3).sum()

    assert seen > 2000
    assert unlike <= 0.002 * seen


def filled(found: Fragments, number: int) -> np.ndarray:
    """Shares (40, 60) of pixels."""
    fill, rows = np.zeros(40 * 60), slice(found.start[number], found.start[number + 1])
    fill[found.pixel[rows]] = found.fill[rows]
    return fill.reshape(40, 60)


@pytest.mark.parametrize(
    ("mesh", "most", "largest"),
    [(trimesh.creation.box((0.1, 0.16, 0.12)), 1 / 32, 1 / 16), (annulus(), 0.07, 0.3)],
    ids=["box", "pipe"],
)
def test_areas_are_those_of_256_rays_a_pixel(
    seed: int, mesh: trimesh.Trimesh, most: float, largest: float
) -> None:
    """95% and all pixels: within what so many rays tell, 1/32 and twice that at a corner.

    Of a pipe, which covers itself, within what four lines through a pixel tell.
    """
    poses = random_poses(np.random.default_rng(seed), 8)
    found = rasterise(mesh_set(mesh), np.zeros(8, np.int64), poses, CAMERA)
    errors = []
    for number, pose in enumerate(poses):
        hit = np.isfinite(cast(mesh, pose, 16)["t_hit"]).reshape(40, 16, 60, 16)
        errors.append(np.abs(filled(found, number) - hit.mean(axis=(1, 3))))
    every = np.array(errors)

    assert np.quantile(every[every > 0], 0.95) < most
    assert every.max() < largest


def test_changes_of_areas_are_differences(seed: int) -> None:
    """As a box moves along x and turns about its own z, seen from the side; but for corners in a pixel."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])[:3, :3]
    pose[:3, 3] = [*rng.uniform(-0.02, 0.02, 2), 0.6]
    box = mesh_set(trimesh.creation.box((0.1, 0.16, 0.12)))
    twists = np.zeros((1, 2, 6))
    twists[0, 0, 0], twists[0, 1, 3:] = 1.0, pose[:3, 2]
    twists[0, 1, :3] = -np.cross(pose[:3, 2], pose[:3, 3])
    found = rasterise(box, np.zeros(1, np.int64), pose[None], CAMERA, twists)
    for motion, step in ((0, 1e-5), (1, 1e-4)):
        ends = []
        for way in (-step, step):
            moved = trimesh.transformations.rotation_matrix(way, [0, 0, 1]) if motion else np.eye(4)
            shift = np.zeros(3) if motion else np.array([way, 0, 0])
            there = pose @ moved
            there[:3, 3] += shift
            ends.append(filled(rasterise(box, np.zeros(1, np.int64), there[None], CAMERA), 0))
        expected = ((ends[1] - ends[0]) / (2 * step)).ravel()[found.pixel]
        wrong = np.abs(found.fill_change[:, motion] - expected) > 1e-2 * np.abs(expected).max()
        assert np.abs(expected).max() > 1
        assert wrong.sum() <= 4


def test_nothing_is_seen_behind_the_camera() -> None:
    """Or across it."""
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[0, 2, 3] = -1

    assert len(rasterise(mesh_set(mesh), np.zeros(2, np.int64), poses, CAMERA).pixel) == 0
