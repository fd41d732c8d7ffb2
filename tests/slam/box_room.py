"""A room whose depth images are known in closed form: six walls and two boxes, cast by slabs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recordings.types import CameraIntrinsics, Frame

INTRINSICS = CameraIntrinsics(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)
ROOM = (np.asarray([-2.0, -1.2, -1.5]), np.asarray([2.3, 1.3, 2.5]))
BOXES = (
    (np.asarray([-0.6, 0.5, 1.0]), np.asarray([0.1, 1.3, 1.5])),
    (np.asarray([0.7, 0.1, 1.4]), np.asarray([1.2, 1.3, 2.1])),
)


def depth_image(pose: NDArray[np.float64], intrinsics: CameraIntrinsics = INTRINSICS) -> NDArray[np.float32]:
    """Exact depth (H, W) seen from world_from_camera (4, 4)."""
    v, u = np.mgrid[0 : intrinsics.height, 0 : intrinsics.width]
    rays = np.stack(
        [(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, np.ones(u.shape)], axis=-1
    )
    directions, origin = rays @ pose[:3, :3].T, pose[:3, 3]
    with np.errstate(divide="ignore"):
        inverse = 1.0 / directions
    depth = np.maximum((ROOM[0] - origin) * inverse, (ROOM[1] - origin) * inverse).min(-1)
    for low, high in BOXES:
        near = np.minimum((low - origin) * inverse, (high - origin) * inverse).max(-1)
        far = np.maximum((low - origin) * inverse, (high - origin) * inverse).min(-1)
        depth = np.where((near < far) & (near > 0), np.minimum(depth, near), depth)
    return depth.astype(np.float32)


def pose(x: float, y: float, z: float, yaw: float = 0.0, pitch: float = 0.0) -> NDArray[np.float64]:
    """world_from_camera (4, 4); metres and radians."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("yx", [yaw, pitch]).as_matrix()
    matrix[:3, 3] = [x, y, z]
    return matrix


def walk(count: int) -> NDArray[np.float64]:
    """A hand-held walk, world_from_camera (T, 4, 4)."""
    times = np.linspace(0, 1, count)
    sway, nod = 0.1 * np.sin(5 * times), 0.1 * np.sin(4 * times)
    along = zip(times, sway, nod, strict=True)
    return np.stack([pose(0.3 * t, y, -0.5 + 0.3 * t, 0.3 * t, pitch) for t, y, pitch in along])


def noisy(depth: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Structured-light noise, 2% without return, 0.5% outliers."""
    sigma = 0.0012 + 0.0019 * (depth - 0.4) ** 2
    measured = depth + sigma * rng.normal(size=depth.shape)
    measured = np.where(rng.random(depth.shape) < 0.005, rng.uniform(0.3, 5.0, depth.shape), measured)
    return np.where(rng.random(depth.shape) < 0.02, 0.0, measured).astype(np.float32)


def frames(
    poses: NDArray[np.float64], seed: int | None = None, intrinsics: CameraIntrinsics = INTRINSICS
) -> list[Frame]:
    """Frames at 30 Hz; exact where there is no seed."""
    rng = None if seed is None else np.random.default_rng(seed)
    images = [depth_image(one, intrinsics) for one in poses]
    images = images if rng is None else [noisy(image, rng) for image in images]
    return [Frame(time_ns=index * 33_333_333, depth_m=image) for index, image in enumerate(images)]
