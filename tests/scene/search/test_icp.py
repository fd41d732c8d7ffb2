"""Our ICP against Open3D's on the same correspondences (docs/model.md, section K)."""

import jax
import jax.numpy as jnp
import numpy as np
import open3d as o3d
import pytest
from scipy.spatial.transform import Rotation

from recordings.types import CameraIntrinsics
from scene.observation.depth_view import pooled_view, unproject
from scene.search.icp import ViewTable, align
from shapes.geometry.poses import matrices_of

INTRINSICS = CameraIntrinsics(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)


def wavy_surface() -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) of a smooth bumpy surface, and its visible points with their normals, every fourth."""
    rows, columns = np.mgrid[:120, :160]
    depth = 0.8 + 0.04 * np.sin(columns / 17) * np.cos(rows / 13) + 0.0004 * columns
    points = unproject(depth.astype(np.float32), INTRINSICS)
    across, down = np.gradient(points, axis=1), np.gradient(points, axis=0)
    normals = np.cross(down, across)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    chosen = (slice(20, 100, 4), slice(30, 130, 4))
    return depth.astype(np.float32), np.stack([points[chosen], normals[chosen]]).reshape(2, -1, 3)


@pytest.mark.parametrize("turn", [(0.02, -0.01, 0.03), (-0.03, 0.02, 0.0)])
def test_it_finds_the_pose_that_open3d_finds(turn: tuple[float, float, float]) -> None:
    """Point to plane from one start: within 0.3 mm and 0.1 degrees of each other and of the truth."""
    depth, (points, normals) = wavy_surface()
    middle = points.mean(axis=0)
    model = (points - middle).astype(np.float32)
    start = np.eye(4)
    start[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    start[:3, 3] = middle + np.array([0.004, -0.003, 0.005])
    wxyz = Rotation.from_matrix(start[:3, :3]).as_quat(scalar_first=True)

    with jax.enable_x64(False):  # as the search runs
        view = ViewTable.of(pooled_view(depth, INTRINSICS, INTRINSICS.width))
        visible = jnp.ones((1, len(model)), bool)
        pose = jnp.asarray([*wxyz, *start[:3, 3]], jnp.float32)[None]
        outward = jnp.asarray(normals, jnp.float32)
        ours = align(view, jnp.asarray(model), outward, visible, pose, 0.01, 0.003, 20)
    ours = matrices_of(np.asarray(ours))[0]

    target = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(unproject(depth, INTRINSICS).reshape(-1, 3)))
    target.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(0.03, 30))
    source = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(model.astype(np.float64)))
    theirs = o3d.pipelines.registration.registration_icp(
        source,
        target,
        0.02,
        start,
        o3d.pipelines.registration.TransformationEstimationPointToPlane(),
        o3d.pipelines.registration.ICPConvergenceCriteria(max_iteration=60),
    ).transformation

    truth = np.eye(4)
    truth[:3, 3] = middle
    for other in (theirs, truth):
        difference = np.linalg.inv(other) @ ours
        assert np.linalg.norm(difference[:3, 3]) < 0.0003
        assert Rotation.from_matrix(difference[:3, :3]).magnitude() < np.radians(0.1)
