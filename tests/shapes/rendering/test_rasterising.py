"""Rasterised meshes are what Embree's rays meet."""

import numpy as np
import open3d as o3d
import trimesh

from recordings.types import CameraIntrinsics
from shapes.rendering.rasterising import Mesh, rasterise

CAMERA = CameraIntrinsics(width=60, height=40, fx=70, fy=65, cx=28.3, cy=21.1)


def test_pixels_depths_and_triangles_are_embrees(seed: int) -> None:
    """At random poses, some partly outside the image; all but pixels on an edge."""
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.annulus(0.05, 0.1, 0.12)
    poses = np.stack([trimesh.transformations.random_rotation_matrix(rng.uniform(size=3)) for _ in range(12)])
    poses[:, :3, 3] = rng.uniform([-0.2, -0.15, 0.45], [0.2, 0.15, 0.8], (12, 3))
    found = rasterise([Mesh(mesh.vertices, mesh.faces)], np.zeros(12, np.int64), poses, CAMERA)

    directions = CAMERA.rays(np.arange(60)[None], np.arange(40)[:, None])
    unlike, seen = 0, 0
    for number, pose in enumerate(poses):
        caster = o3d.t.geometry.RaycastingScene(nthreads=1)
        points = trimesh.transform_points(mesh.vertices, pose).astype(np.float32)
        faces = mesh.faces.astype(np.uint32)
        caster.add_triangles(o3d.core.Tensor.from_numpy(points), o3d.core.Tensor.from_numpy(faces))
        rays = np.concatenate([np.zeros_like(directions), directions], axis=-1).astype(np.float32)
        hits = caster.cast_rays(o3d.core.Tensor.from_numpy(rays))
        expected = hits["t_hit"].numpy().ravel()
        rows = slice(found.start[number], found.start[number + 1])
        depth = np.full(expected.shape, np.inf)
        depth[found.pixel[rows]] = found.depth_m[rows]
        both = np.isfinite(depth) & np.isfinite(expected)
        seen += np.isfinite(expected).sum()
        unlike += (np.isfinite(depth) != np.isfinite(expected)).sum()
        unlike += (np.abs(depth[both] - expected[both]) > 1e-4).sum()
        theirs = hits["primitive_ids"].numpy().ravel()[found.pixel[rows]][both[found.pixel[rows]]]
        ours = found.face[rows][both[found.pixel[rows]]]
        unlike += (np.abs(mesh.face_normals[theirs] - mesh.face_normals[ours]).max(axis=1) > 1e-3).sum()

    assert seen > 2000
    assert unlike <= 0.002 * seen


def test_nothing_is_seen_behind_the_camera() -> None:
    """Or across it."""
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[0, 2, 3] = -1

    assert len(rasterise([Mesh(mesh.vertices, mesh.faces)], np.zeros(2, np.int64), poses, CAMERA).pixel) == 0
