"""The cheap score of proposals against exact distances to the mesh."""

import jax.numpy as jnp
import numpy as np
import open3d as o3d
import trimesh

from pipeline.benchmarks.distance_score import distance_score
from shapes.rendering.object_library import join, library_of_mesh
from tests.shapes.views import posed, random_views

SCALE_M = 0.01


def reference(mesh: trimesh.Trimesh, pose: np.ndarray, points_m: np.ndarray) -> float:
    """The mean over points, with distances by Open3D."""
    scene = o3d.t.geometry.RaycastingScene()
    tensor = o3d.core.Tensor.from_numpy
    scene.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(mesh.faces.astype(np.uint32)))
    local = (points_m - pose[:3, 3]) @ pose[:3, :3]
    distance = scene.compute_distance(tensor(local.astype(np.float32))).numpy()
    return float(np.maximum(1 - (distance / SCALE_M) ** 2, 0).mean())


def test_scores_agree_with_exact_distances(seed: int) -> None:
    """Within 0.01 of the score by exact distances, for points round the object and far from it.

    The plane of a 2 mm voxel errs by a fraction of a voxel at edges alone: 0.3 mm at half the scale is
    0.03 for such a point, and few are.
    """
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.cylinder(0.034, 0.102, sections=64)
    library = library_of_mesh(mesh.vertices, mesh.faces, 0.001)
    poses = random_views(rng, mesh, 20)
    surface = trimesh.sample.sample_surface(mesh, 300, seed=seed % 2**31)[0]
    points = surface @ poses[0, :3, :3].T + poses[0, :3, 3] + rng.normal(0, 0.006, (300, 3))
    poses[1:10] = poses[0]
    poses[1:10, :3, 3] += rng.normal(0, 0.01, (9, 3))

    actual = distance_score(library, posed(poses), jnp.asarray(points)[None], SCALE_M)

    expected = [reference(mesh, pose, points) for pose in poses]
    assert max(expected) > 0.3
    np.testing.assert_allclose(np.asarray(actual), expected, atol=0.01)


def test_padding_and_damaged_points_count_for_nothing() -> None:
    """Points behind the camera and points that are not numbers leave the mean of the others."""
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    library = join([library_of_mesh(mesh.vertices, mesh.faces, 0.002)] * 2)
    pose = np.eye(4)[None].copy()
    pose[0, 2, 3] = 0.5
    good = np.array([[0, 0, 0.45], [0, 0, 0.6]])
    bad = np.array([[0, 0, -0.45], [np.nan, 0, 0.45], [0, np.inf, 0.45], [0, 0, np.nan], [0, 0, 0]])

    alone = distance_score(library, posed(pose, 1), jnp.asarray(good)[None], SCALE_M)
    mixed = distance_score(library, posed(pose, 1), jnp.asarray(np.concatenate([good, bad]))[None], SCALE_M)
    none = distance_score(library, posed(pose, 1), jnp.asarray(bad)[None], SCALE_M)

    np.testing.assert_allclose(np.asarray(alone), 0.5, atol=0.01)
    np.testing.assert_allclose(np.asarray(mixed), np.asarray(alone))
    np.testing.assert_array_equal(np.asarray(none), 0)
