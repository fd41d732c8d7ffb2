"""The camera over a table, and a colour image as the search wants it: few pixels, linear in light.

World frame: the table's top is z = 0, z up; the origin is where the optical axis meets it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics

LONGEST_PX = 72
"""Pixels of the longer side after pooling: an object of 8 cm in a view of half a metre covers about ten, with
which `bench air` places it to a millimetre; time grows with their number."""
LARGEST_HALF_M = 0.3
"""Half the side of the largest square that is searched: its lattice has 900 places, rendered in seconds."""
SMALLEST_HALF_M = 0.05
"""Below it the table fills a corner of the image at most."""
CLIPPED = 0.5
"""Share of a block's pixels from which its mean tells a bound alone."""
HALVINGS = 20
"""Of the interval in which the square's half side lies: to a micrometre."""


def camera_over_table(height_m: float, pitch_rad: float, roll_rad: float = 0.0) -> NDArray[np.float64]:
    """camera_from_world (4, 4) of a camera over the table.

    Args:
        height_m: of the camera over the table's top.
        pitch_rad: angle by which the optical axis points below the horizontal.
        roll_rad: angle by which the camera is turned clockwise about its axis, as it looks.

    Raises:
        ValueError: the optical axis does not meet the table.
    """
    if height_m <= 0 or not 0 < pitch_rad <= np.pi / 2:
        raise ValueError(
            "a camera over the table has a height above 0 and a pitch between 0 and 90 degrees downwards, "
            f"got {height_m:g} m and {np.degrees(pitch_rad):g} degrees"
        )
    sine, cosine = np.sin(pitch_rad), np.cos(pitch_rad)
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, -sine, -cosine], [0, cosine, -sine]]
    pose[2, 3] = height_m / sine
    rolled = np.eye(4)
    rolled[:2, :2] = [[np.cos(roll_rad), np.sin(roll_rad)], [-np.sin(roll_rad), np.cos(roll_rad)]]
    return rolled @ pose


def camera_over_plane(camera_from_plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """camera_from_world (4, 4) where the table's top is z = 0 of another frame, (4, 4) z up.

    Raises:
        ValueError: the camera does not look down on that plane.
    """
    plane_from_camera = np.linalg.inv(camera_from_plane)
    place, axis = plane_from_camera[:3, 3], plane_from_camera[:3, 2]
    if place[2] <= 0 or axis[2] >= -1e-6:
        raise ValueError("the camera does not look down on the table, which is the plane z = 0")
    plane_from_world = np.eye(4)
    plane_from_world[:3, 3] = place - axis * (place[2] / axis[2])
    return camera_from_plane @ plane_from_world


def square_in_view(camera: CameraIntrinsics, camera_from_world: NDArray[np.float64]) -> float:
    """Half the side of the largest square round the world's origin that the image shows whole.

    Raises:
        ValueError: it shows none that is worth searching.
    """
    corners = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1.0]])

    def is_seen(half_m: float) -> bool:
        points = np.column_stack([half_m * corners, np.zeros(4)])
        x, y, z = camera_from_world[:3, :3] @ points.T + camera_from_world[:3, 3:]
        if z.min() <= 0:
            return False
        column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (column >= 0) & (column <= camera.width - 1) & (row >= 0) & (row <= camera.height - 1)
        return bool(inside.all())

    low, high = 0.0, LARGEST_HALF_M
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if is_seen(middle) else (low, middle)
    if low < SMALLEST_HALF_M:
        raise ValueError("the image shows no square of the table of 10 cm round its middle")
    return low


def pooled_image(
    rgb: NDArray[np.uint8], camera: CameraIntrinsics, gamma: float
) -> tuple[NDArray[np.float64], CameraIntrinsics]:
    """Image (h, w, C) in 0..1, linear in light, averaged over blocks of pixels, and its camera.

    A grey image has one channel: its three would count the same noise three times. Channels of blocks that
    are clipped in more than half of their pixels are +inf or -inf.

    Args:
        rgb: (H, W, 3).
        camera: of the image.
        gamma: exponent by which stored values become light.
    """
    is_grey = bool((rgb == rgb[..., :1]).all())
    stored = rgb[..., : 1 if is_grey else 3]
    light = (stored / 255.0) ** gamma
    block = -(-max(camera.width, camera.height) // LONGEST_PX)
    height, width = camera.height // block, camera.width // block

    def means(values: NDArray) -> NDArray[np.float64]:
        blocks = values[: height * block, : width * block].reshape(height, block, width, block, -1)
        return blocks.mean(axis=(1, 3))

    pooled = CameraIntrinsics(
        width=width,
        height=height,
        fx=camera.fx / block,
        fy=camera.fy / block,
        cx=(camera.cx + 0.5) / block - 0.5,
        cy=(camera.cy + 0.5) / block - 0.5,
    )
    pooled_light = means(light)
    pooled_light[means(stored == 255) > CLIPPED] = np.inf
    pooled_light[means(stored == 0) > CLIPPED] = -np.inf
    return pooled_light, pooled


def clipped_share(rgb: NDArray[np.uint8]) -> float:
    """Share of pixels of which a channel is as dark or as bright as can be stored."""
    return float(((rgb == 0) | (rgb == 255)).any(axis=-1).mean())
