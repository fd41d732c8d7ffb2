"""Depth images of boxes on a table, and the views that a parse has of them."""

import jax.numpy as jnp
import numpy as np

from scene.observation.depth_view import PooledView
from scene.observation.detection import SupportPlane
from shapes.geometry.camera import Camera
from tests.scene.observation.test_detection import CAMERA_FROM_TABLE

HALF_SIZE_M = np.array([0.3, 0.2])
WIDTH, HEIGHT, FOCAL = 160, 120, 140.0
MIDDLE_PX = np.array([79.5, 59.5])
TABLE = SupportPlane(camera_from_table=CAMERA_FROM_TABLE, half_size_m=HALF_SIZE_M, bend=np.zeros(6))


def depth_of(boxes: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Depth (H, W) of upright boxes, middle and half size in the table's frame, on the plane z = 0: slabs."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - MIDDLE_PX[0]) / FOCAL, (v - MIDDLE_PX[1]) / FOCAL, np.ones(u.shape)], axis=-1)
    turn, origin = CAMERA_FROM_TABLE[:3, :3], -CAMERA_FROM_TABLE[:3, :3].T @ CAMERA_FROM_TABLE[:3, 3]
    rays = rays @ turn
    depth = -origin[2] / rays[..., 2]
    for middle, half in boxes:
        ends = np.sort((middle + np.array([-1, 1])[:, None] * half - origin)[:, None, None] / rays, axis=0)
        near, far = ends[0].max(axis=-1), ends[1].min(axis=-1)
        depth = np.where(near < far, np.minimum(depth, near), depth)
    return depth.astype(np.float32)


def view_of(depth_m: np.ndarray) -> PooledView:
    """The image as a parse sees it."""
    camera = Camera(*(jnp.asarray(value) for value in (FOCAL, FOCAL, *MIDDLE_PX)))
    nothing = jnp.zeros(depth_m.shape, bool)
    return PooledView(camera, jnp.asarray(depth_m), jnp.zeros((*depth_m.shape, 3)), nothing)
