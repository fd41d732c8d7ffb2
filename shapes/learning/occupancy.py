"""Occupancy of a grid for one trajectory: p(O = 1 | M_k, x_k, I) of one particle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN, CameraIntrinsics
from shapes.geometry.camera import Camera
from shapes.geometry.poses import transform_points
from shapes.learning.config import LearnConfig
from shapes.learning.expectation_propagation import voxel_states
from shapes.learning.local_planes import LocalPlanes, local_planes
from shapes.learning.readings import BEFORE, BEHIND, NEAR, initial_readings, voxel_readings
from shapes.learning.surfels import surfels
from shapes.learning.view_readings import ViewReadings
from shapes.learning.voxel_rays import bucket, evidence, wall_normals
from shapes.surfels import Surfels
from shapes.voxel_grid import VoxelGrid

WINDOW_MARGIN = 8
"""Pixels round the object's window."""
WINDOW_BUCKET = 64
"""Window sizes are rounded up to it, for fewer kernels."""
VOXEL_BUCKET = 8192
"""Voxel counts are rounded up to it, for fewer kernels."""
REACHED = 0.5
"""Half of a ray's probability."""
NEAR_PITCHES = 1.5
"""As `AT_SURFACE_PITCHES` of colouring."""
NEAR_M = 0.008
"""Voxels farther from a surface than both are plainly before or behind it."""
LARGEST_HALF_WINDOW = 3
"""Pixels: compile time."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """The part of a depth image that shows the grid.

    Attributes:
        planes: the surface round each of its pixels.
        corner: column and row of its first pixel.
    """

    planes: LocalPlanes
    corner: tuple[int, int]


@dataclass(frozen=True, kw_only=True, eq=False)
class Occupancy:
    """What one trajectory says of every voxel, raveled (N,).

    Attributes:
        phi: probability of being occupied; p_hidden where hidden, p0 where never seen.
        seen: a ray came as far as the voxel.
        hidden: behind seen surface, and no ray came as far.
        surfels: where the surface is beside the voxels.
    """

    phi: NDArray[np.float64]
    seen: NDArray[np.bool_]
    hidden: NDArray[np.bool_]
    surfels: Surfels


def windows(
    depths_m: Sequence[NDArray[np.float32]],
    intrinsics: CameraIntrinsics,
    grid: VoxelGrid,
    reference_from_camera: NDArray[np.float64],
    config: LearnConfig,
) -> list[Window | None]:
    """Windows of one size for all views; None for a view whose image does not show the grid."""
    boxes = [_image_box(intrinsics, grid, pose) for pose in reference_from_camera]
    sizes = [box[1] - box[0] for box in boxes if box is not None]
    if not sizes:
        return [None] * len(boxes)
    width, height = (-(-int(most) // WINDOW_BUCKET) * WINDOW_BUCKET for most in np.max(sizes, axis=0))
    camera = Camera.from_intrinsics(intrinsics)
    distance = np.median([_distance(grid, pose) for pose in reference_from_camera])
    footprint = grid.pitch_m * intrinsics.fx / distance
    half = int(np.clip(round((footprint - 1) / 3), 1, LARGEST_HALF_WINDOW))
    found: list[Window | None] = []
    for depth, box in zip(depths_m, boxes, strict=True):
        if box is None:
            found.append(None)
            continue
        left, top = (int(value) for value in box[0])
        part = depth[top : top + height, left : left + width]
        image = np.full((height, width), NO_RETURN, np.float32)
        image[: part.shape[0], : part.shape[1]] = part
        planes = local_planes(jnp.asarray(image), camera, config.noise, half=half)
        found.append(Window(planes=planes, corner=(left, top)))
    return found


def occupancy(
    views: Sequence[Window | None],
    intrinsics: CameraIntrinsics,
    grid: VoxelGrid,
    reference_from_camera: NDArray[np.float64],
    config: LearnConfig,
) -> Occupancy:
    """Distribution of the grid's voxels given every view at the poses (T, 4, 4) of one trajectory."""
    count = len(grid)
    padded = np.zeros((-(-count // VOXEL_BUCKET) * VOXEL_BUCKET, 3), np.float32)
    padded[:count] = grid.centres_m
    centres = jnp.asarray(padded)
    camera = Camera.from_intrinsics(intrinsics)
    readings = _readings(views, camera, grid, reference_from_camera, centres, config)
    states, log_prior = _states(config)
    p0 = config.prior_occupied
    if not readings:
        nothing = np.zeros(count, np.bool_)
        return Occupancy(phi=np.full(count, p0), seen=nothing, hidden=nothing, surfels=Surfels.none())
    walls = wall_normals(readings, grid)
    found = evidence(readings, walls, grid, states, config)
    prior = np.broadcast_to(log_prior, (len(padded), len(log_prior))).astype(np.float32).copy()
    prior[:count] += found.log_crossings
    posterior = voxel_states(
        found.rays,
        jnp.asarray(prior),
        jnp.asarray(states, jnp.float32),
        sweeps=config.sweeps,
        damping=config.damping,
    )
    phi = np.asarray(posterior.probability[:count, 0], np.float64)
    seen = (found.crossed > REACHED) | (np.asarray(posterior.reach[:count]) > REACHED)
    hidden = ~seen & found.hidden
    beside = surfels(readings, walls, grid, config.shared_sigma_m)
    phi = np.where(seen, phi, np.where(hidden, config.hidden_occupied, p0))
    return Occupancy(phi=phi, seen=seen, hidden=hidden, surfels=beside)


def _states(config: LearnConfig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Opacities (2, C) of a voxel's states for rays from its wall's two sides, and their log prior (C,).

    Occupied; partly filled; free with a wall before its centre, seen from the one side or from the other;
    empty.
    """
    part = config.partial_opacity
    opacity = np.asarray([[1.0, part, 1.0, 0.0, 0.0], [1.0, part, 0.0, 1.0, 0.0]])
    p0, partly, walled = config.prior_occupied, config.partly_filled, config.walled
    shares = [partly, walled / 2, walled / 2, 1 - partly - walled]
    prior = np.asarray([p0, *((1 - p0) * share for share in shares)])
    return opacity, np.log(np.maximum(prior, 1e-30))


def _readings(
    views: Sequence[Window | None],
    camera: Camera,
    grid: VoxelGrid,
    reference_from_camera: NDArray[np.float64],
    centres_m: jnp.ndarray,
    config: LearnConfig,
) -> list[ViewReadings]:
    """Readings of the voxels near surfaces in each view; the centres (N, 3) are padded."""
    margin = max(NEAR_PITCHES * grid.pitch_m, NEAR_M)
    shown = [
        (view, np.linalg.inv(pose) @ grid.reference_from_grid, _distance(grid, pose))
        for view, pose in zip(views, reference_from_camera, strict=True)
        if view is not None
    ]
    looks = [
        np.asarray(
            initial_readings(
                view.planes,
                camera,
                jnp.asarray(view.corner, jnp.float32),
                jnp.asarray(camera_from_grid, jnp.float32),
                centres_m,
                margin,
            )
        )[: len(grid)]
        for view, camera_from_grid, _ in shown
    ]
    most = bucket(max((int((look == NEAR).sum()) for look in looks), default=0), VOXEL_BUCKET)
    return [
        _read(view, camera, grid, camera_from_grid, look, most, distance, config)
        for (view, camera_from_grid, distance), look in zip(shown, looks, strict=True)
    ]


def _read(
    view: Window,
    camera: Camera,
    grid: VoxelGrid,
    camera_from_grid: NDArray[np.float64],
    look: NDArray[np.int8],
    most: int,
    distance_m: float,
    config: LearnConfig,
) -> ViewReadings:
    """One view's readings, made for `most` voxels so that all views share a compiled kernel."""
    voxel = np.flatnonzero(look == NEAR)
    centres = (np.stack(np.unravel_index(voxel, grid.shape), axis=1) + 0.5) * grid.pitch_m
    padded = np.zeros((most, 3), np.float32)
    padded[: len(voxel)] = centres
    readings = voxel_readings(
        view.planes,
        camera,
        jnp.asarray(view.corner, jnp.float32),
        jnp.asarray(camera_from_grid, jnp.float32),
        jnp.asarray(padded),
        config.registration_sigma_m,
    )
    arrays = {name: np.asarray(value)[: len(voxel)] for name, value in vars(readings).items()}
    near = (arrays["association"] > 0) & (np.abs(arrays["behind_m"]) <= grid.pitch_m)
    near = near.any(axis=1)
    normal = np.zeros((len(voxel), 3), np.float32)
    in_camera = _normals(view, camera, arrays["column"][near], arrays["row"][near])
    normal[near] = in_camera @ camera_from_grid[:3, :3]
    eye = np.asarray(np.linalg.inv(camera_from_grid)[:3, 3], np.float64)
    plane = np.full(len(voxel), np.inf, np.float32)
    if grid.on_plane:
        height = centres[:, 2]
        above = eye[2] > height
        plane[above] = arrays["depth_m"][above] * (eye[2] / (eye[2] - height[above]))
    return ViewReadings.of(
        look == BEFORE,
        look == BEHIND,
        voxel,
        arrays | {"normal": normal, "plane_depth_m": plane},
        grid,
        eye_m=eye,
        footprint=grid.pitch_m * float(camera.fx) / distance_m,
    )


def _normals(
    view: Window, camera: Camera, column: NDArray[np.floating], row: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Unit normals (N, 3) in the camera's axes, towards it, of the surface at the nearest pixels."""
    height, width = view.planes.valid.shape
    u = np.clip(np.rint(column).astype(int) - view.corner[0], 0, width - 1)
    v = np.clip(np.rint(row).astype(int) - view.corner[1], 0, height - 1)
    inverse = np.asarray(view.planes.inverse_depth)[v, u].astype(np.float64)
    slope_u, slope_v = np.asarray(view.planes.slope)[:, v, u].astype(np.float64)
    # 1/z = (A x + B y + C z) / z is a plane A x + B y + C z = 1
    at_centre = inverse - slope_u * (u + view.corner[0] - float(camera.cx))
    at_centre -= slope_v * (v + view.corner[1] - float(camera.cy))
    normal = -np.stack([slope_u * float(camera.fx), slope_v * float(camera.fy), at_centre], axis=-1)
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)


def _distance(grid: VoxelGrid, reference_from_camera: NDArray[np.float64]) -> float:
    """From the camera to the middle of the grid."""
    middle = grid.reference_from_grid @ [*(np.asarray(grid.shape) * grid.pitch_m / 2), 1.0]
    return float(max(np.linalg.norm(middle[:3] - reference_from_camera[:3, 3]), 0.05))


def _image_box(
    intrinsics: CameraIntrinsics, grid: VoxelGrid, reference_from_camera: NDArray[np.float64]
) -> NDArray[np.int64] | None:
    """First pixel and the one after the last (2, 2), column and row, of the grid in an image."""
    extent = np.asarray(grid.shape) * grid.pitch_m
    corners = np.stack(np.meshgrid(*([0.0, side] for side in extent)), axis=-1).reshape(-1, 3)
    camera_from_grid = np.linalg.inv(reference_from_camera) @ grid.reference_from_grid
    x, y, z = transform_points(camera_from_grid, corners).T
    size = np.asarray([intrinsics.width, intrinsics.height])
    if z.max() <= 0:
        return None
    if z.min() <= 1e-3:  # the camera is inside or beside the grid
        return np.stack([np.zeros(2, np.int64), size])
    pixels = np.stack([intrinsics.fx * x / z + intrinsics.cx, intrinsics.fy * y / z + intrinsics.cy], axis=1)
    low = np.clip(np.floor(pixels.min(axis=0)).astype(np.int64) - WINDOW_MARGIN, 0, size)
    high = np.clip(np.ceil(pixels.max(axis=0)).astype(np.int64) + WINDOW_MARGIN + 1, 0, size)
    return np.stack([low, high]) if (high > low).all() else None
