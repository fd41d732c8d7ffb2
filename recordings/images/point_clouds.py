"""Point clouds as depth images: the sensor's own grid where it kept one, else a projection."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from recordings.images.depth_pixels import MAX_PIXELS
from recordings.messages.types import PointCloudMessage, UndecodableMessage
from recordings.types import NO_RETURN, CameraIntrinsics

OPTICAL_FROM_BODY = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""From a frame with x forward, y left, z up to one with z forward, x right, y down (ROS REP 103)."""

_PINHOLE_TOLERANCE_PX = 0.5
_SHARE_OF_POINTS_SEEN = 0.99
_WIDEST_TANGENT = 1.5
_POINTS_PER_PIXEL = 2.0
_SIDE_LIMITS_PX = (16, 1280)


def points_of(cloud: PointCloudMessage) -> NDArray[np.float32]:
    """The points (height, width, 3) in the cloud's frame; NaN or infinite where there is none.

    Raises:
        UndecodableMessage: the fields or sizes contradict the data.
    """
    width, height, step = cloud.width, cloud.height, cloud.point_step
    if not (width > 0 < height and width * height <= MAX_PIXELS):
        raise UndecodableMessage(f"claims to be a cloud of {width}x{height} points")
    row_step = max(cloud.row_step, width * step)
    if len(cloud.data) < row_step * (height - 1) + width * step:
        raise UndecodableMessage(f"has {len(cloud.data)} bytes for {width}x{height} points of {step}")
    fields = {field.name: field for field in cloud.fields}
    points = np.empty((height, width, 3), np.float32)
    for axis, name in enumerate("xyz"):
        if name not in fields:
            raise UndecodableMessage(f"has no field {name!r}")
        offset, dtype = fields[name].offset, fields[name].dtype
        if not 0 <= offset <= step - dtype.itemsize:
            raise UndecodableMessage(f"has its field {name!r} outside of a point")
        points[..., axis] = np.ndarray((height, width), dtype, cloud.data, offset, (row_step, step))
    if not np.array_equal(cloud.frame_from_points, np.eye(4)):
        pose = cloud.frame_from_points.astype(np.float32)
        points = points @ pose[:3, :3].T + pose[:3, 3]
    return points


def pinhole_of_grid(points: NDArray[np.float32]) -> CameraIntrinsics | None:
    """The pinhole camera whose pixels an organised cloud's rows and columns are, if they are.

    Least squares of u = fx x / z + cx and v = fy y / z + cy over the points.
    """
    height, width = points.shape[:2]
    x, y, z = np.moveaxis(points.astype(np.float64), -1, 0)
    seen: NDArray[np.bool_] = np.isfinite(points).all(axis=-1) & (z > 0)
    if height < 2 or width < 2 or np.count_nonzero(seen) < width:
        return None
    row, column = np.nonzero(seen)
    fx, cx, error_x = _line(x[seen] / z[seen], column)
    fy, cy, error_y = _line(y[seen] / z[seen], row)
    if not (fx > 0 < fy and error_x < _PINHOLE_TOLERANCE_PX and error_y < _PINHOLE_TOLERANCE_PX):
        return None
    return CameraIntrinsics(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def looks_along_x(frame_id: str, points: NDArray[np.float32]) -> bool:
    """Whether a cloud's frame is a body's (x forward) and not a camera's optical one (z forward)."""
    if "optical" in frame_id:
        return False
    finite = points[np.isfinite(points).all(axis=-1)]
    across_z = np.count_nonzero(finite[:, 2] > np.abs(finite[:, :2]).max(axis=-1, initial=0.0))
    across_x = np.count_nonzero(finite[:, 0] > np.abs(finite[:, 1:]).max(axis=-1, initial=0.0))
    return bool(across_x > across_z)


def virtual_camera(points: NDArray[np.float32]) -> CameraIntrinsics:
    """A pinhole camera at the origin of (N, 3) optical points that sees most of them, some to a pixel.

    Raises:
        UndecodableMessage: no point lies in front.
    """
    in_front = points[np.isfinite(points).all(axis=-1) & (points[:, 2] > 0)].astype(np.float64)
    if len(in_front) < 2:
        raise UndecodableMessage("has no points in front of its frame")
    directions = in_front[:, :2] / in_front[:, 2:]
    outside = (1 - _SHARE_OF_POINTS_SEEN) / 2
    low, high = np.quantile(directions, [outside, 1 - outside], axis=0).clip(
        -_WIDEST_TANGENT, _WIDEST_TANGENT
    )
    extent = np.maximum(high - low, 1e-3)
    focal = math.sqrt(len(in_front) / (_POINTS_PER_PIXEL * float(extent[0] * extent[1])))
    smallest, largest = _SIDE_LIMITS_PX
    focal = min(focal, (largest - 1) / float(extent.max()))
    width, height = (int(np.clip(math.ceil(focal * e), smallest, largest)) for e in extent)
    middle = (low + high) / 2
    return CameraIntrinsics(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=(width - 1) / 2 - focal * float(middle[0]),
        cy=(height - 1) / 2 - focal * float(middle[1]),
    )


def projected(points: NDArray[np.float32], camera: CameraIntrinsics) -> NDArray[np.float32]:
    """The depth image of (N, 3) optical points: the nearest point of each pixel, `NO_RETURN` without one."""
    pixel, z = _in_view(points, camera)
    nearest = np.full(camera.width * camera.height, np.inf, np.float32)
    np.minimum.at(nearest, pixel, z)
    nearest[np.isinf(nearest)] = NO_RETURN
    return nearest.reshape(camera.height, camera.width)


def share_in_view(points: NDArray[np.float32], camera: CameraIntrinsics) -> float:
    """Which share of the finite ones of (N, 3) optical points a camera sees, hidden ones with them."""
    finite = int(np.count_nonzero(np.isfinite(points).all(axis=-1)))
    return len(_in_view(points, camera)[0]) / max(finite, 1)


def _in_view(
    points: NDArray[np.float32], camera: CameraIntrinsics
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Pixel number and depth of those of (N, 3) optical points that fall into the image."""
    points = points[np.isfinite(points).all(axis=-1) & (points[:, 2] > 0)]
    with np.errstate(over="ignore"):
        u = np.rint(camera.fx * points[:, 0] / points[:, 2] + camera.cx)
        v = np.rint(camera.fy * points[:, 1] / points[:, 2] + camera.cy)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return v[inside].astype(np.intp) * camera.width + u[inside].astype(np.intp), points[inside, 2]


def _line(x: NDArray[np.float64], y: NDArray[np.intp]) -> tuple[float, float, float]:
    """Slope, offset and root mean square residual of y over x."""
    spread = float(x.var())
    if not spread > 0:
        return 0.0, 0.0, math.inf
    slope = float(np.mean((x - x.mean()) * (y - y.mean()))) / spread
    offset = float(y.mean() - slope * x.mean())
    return slope, offset, float(np.sqrt(np.mean((y - slope * x - offset) ** 2)))
