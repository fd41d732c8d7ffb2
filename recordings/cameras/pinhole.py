"""The pinhole intrinsics of an image as it is stored: region of interest, binning and resizing applied."""

from __future__ import annotations

from recordings.messages.types import CameraMessage
from recordings.options import LARGEST_PX
from recordings.types import CameraIntrinsics

NO_CALIBRATION = "no usable calibration of its camera is recorded; give --intrinsics fx,fy,cx,cy"

_ASPECT_TOLERANCE_PX = 1.5
"""Sizes of resized images are rounded to whole pixels."""
_FOCAL_WIDTHS = (0.05, 100.0)
"""Focal length over image width: views of 169 and of 0.6 degrees, beyond which no depth camera sees."""


class UnusableCamera(Exception):  # noqa: N818  (never leaves recordings)
    """A camera message cannot have been of these images; the text says why."""


def is_calibrated(camera: CameraMessage) -> bool:
    """Whether a camera message holds a calibration; drivers send zeros before they know it."""
    return bool(camera.K[0, 0] > 0 and camera.K[1, 1] > 0)


def stored_intrinsics(camera: CameraMessage, width: int, height: int, *, rectified: bool) -> CameraIntrinsics:
    """The intrinsics of the stored image of `width` x `height` pixels.

    K and P are given for the whole sensor (sensor_msgs/msg/CameraInfo): the region of interest moves
    the principal point, binning divides, and where the stored size is still another one, the image was
    resized. Pixel centres are integers, so cx' = (cx + 0.5) s - 0.5.

    Raises:
        UnusableCamera: the image is empty, or has another shape than the camera's.
    """
    if min(width, height) <= 0:
        raise UnusableCamera(f"its images claim to have {width}x{height} pixels")
    matrix = camera.P[:, :3] if rectified and camera.P[0, 0] > 0 < camera.P[1, 1] else camera.K
    x, y, roi_width, roi_height = camera.roi
    if roi_width <= 0 or roi_height <= 0 or (width, height) == (camera.width, camera.height):
        x, y, roi_width, roi_height = 0, 0, camera.width, camera.height
    # A camera message without a size is taken to describe the image as it is stored.
    roi_width, roi_height = roi_width or width, roi_height or height
    scale_x, scale_y = width / roi_width, height / roi_height
    if abs(scale_x * roi_height - height) > _ASPECT_TOLERANCE_PX and not _is_binned(camera, scale_x, scale_y):
        raise UnusableCamera(
            f"its camera is for images of {roi_width}x{roi_height}, they are {width}x{height}; "
            "give --intrinsics fx,fy,cx,cy"
        )
    try:
        region = CameraIntrinsics(
            width=roi_width,
            height=roi_height,
            fx=float(matrix[0, 0]),
            fy=float(matrix[1, 1]),
            cx=float(matrix[0, 2]) - x,
            cy=float(matrix[1, 2]) - y,
        )
    except ValueError as error:
        raise UnusableCamera(f"its camera is unusable: {error}; give --intrinsics fx,fy,cx,cy") from error
    low, high = _FOCAL_WIDTHS
    if not all(low < focal / region.width < high for focal in (region.fx, region.fy)):
        raise UnusableCamera(
            f"its camera is unusable: focal lengths of {region.fx:g} and {region.fy:g} pixels are not "
            f"those of images of {region.width}x{region.height}; give --intrinsics fx,fy,cx,cy"
        )
    if not all(abs(centre) < LARGEST_PX for centre in (region.cx, region.cy)):
        raise UnusableCamera(
            f"its camera is unusable: a principal point at {region.cx:g}, {region.cy:g} pixels is none; "
            "give --intrinsics fx,fy,cx,cy"
        )
    return region.resized(width, height)


def _is_binned(camera: CameraMessage, scale_x: float, scale_y: float) -> bool:
    """Whether the two scales are those of the camera's (unequal) binning, up to a resize."""
    expected = camera.binning[0] / camera.binning[1]
    return abs(scale_y / scale_x - expected) < 0.01 * expected
