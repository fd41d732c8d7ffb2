"""Random views of objects and what Open3D's ray casting sees in them."""

import jax.numpy as jnp
import numpy as np
import open3d as o3d
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recordings.types import CameraIntrinsics
from shapes.geometry.camera import Camera, stacked
from shapes.rendering.ray_casting import PosedObjects

INTRINSICS = CameraIntrinsics(width=128, height=96, fx=140.0, fy=145.0, cx=60.3, cy=50.1)


def cameras(intrinsics: CameraIntrinsics = INTRINSICS) -> Camera:
    """One camera with leaves (1,)."""
    return stacked([Camera.from_intrinsics(intrinsics)])


def posed(camera_from_object: NDArray[np.floating], object_index: int = 0) -> PosedObjects:
    """Hypotheses (N, 4, 4) of one object before the first camera."""
    count = len(camera_from_object)
    return PosedObjects(
        jnp.full(count, object_index, jnp.int32),
        jnp.asarray(camera_from_object, jnp.float32),
        jnp.zeros(count, jnp.int32),
    )


def random_views(rng: np.random.Generator, mesh: trimesh.Trimesh, count: int) -> NDArray[np.float64]:
    """Poses camera_from_object (count, 4, 4): a third each from afar, close up, and along a box face."""
    centre = mesh.bounds.mean(axis=0)
    radius = np.linalg.norm(mesh.vertices - centre, axis=1).max()
    poses = np.tile(np.eye(4), (count, 1, 1))
    for index in range(count):
        rotation = Rotation.random(rng=rng).as_matrix()
        distance = radius * rng.uniform(4.0, 8.0)
        if index % 3 == 1:
            distance = radius * rng.uniform(1.2, 2.0)
        if index % 3 == 2:
            rotation = grazing_rotation(rng)
        place = np.array([*rng.uniform(-0.2, 0.2, 2) * distance, distance])
        poses[index, :3, :3] = rotation
        poses[index, :3, 3] = place - rotation @ centre
    return poses


def grazing_rotation(rng: np.random.Generator) -> NDArray[np.float64]:
    """A view direction within 6 degrees of the plane of some face of the bounding box."""
    axis = np.eye(3)[rng.integers(3)]
    within = np.cross(axis, rng.normal(size=3))
    tilt = np.deg2rad(rng.uniform(0.5, 6.0))
    forward = np.cos(tilt) * within / np.linalg.norm(within) + np.sin(tilt) * axis
    right = np.cross(forward, rng.normal(size=3))
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def ray_cast(
    mesh: trimesh.Trimesh, camera_from_object: NDArray[np.float64], intrinsics: CameraIntrinsics = INTRINSICS
) -> NDArray[np.float32]:
    """Depth images (N, H, W) by Embree through the integer pixel centres, +inf where nothing is met."""
    scene = embree(mesh)
    matrix = np.array(
        [[intrinsics.fx, 0, intrinsics.cx + 0.5], [0, intrinsics.fy, intrinsics.cy + 0.5], [0, 0, 1]]
    )
    images = []
    for pose in camera_from_object:
        rays = o3d.t.geometry.RaycastingScene.create_rays_pinhole(
            tensor(matrix), tensor(pose), intrinsics.width, intrinsics.height
        )
        depth_per_length = rays.numpy()[..., 3:] @ pose[2, :3]
        images.append(scene.cast_rays(rays)["t_hit"].numpy() * depth_per_length)
    return np.stack(images).astype(np.float32)


def embree(mesh: trimesh.Trimesh) -> o3d.t.geometry.RaycastingScene:
    """Open3D's ray casting scene of one mesh."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(mesh.faces.astype(np.uint32)))
    return scene


def tensor(values: NDArray) -> o3d.core.Tensor:
    """An Open3D tensor of the same values."""
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values))
