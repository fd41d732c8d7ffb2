"""Lens distortion of depth images: the lookup that makes an unrectified image a pinhole one.

Depth along the optical axis does not change with the pixel that a ray falls on, so undistorting only
moves pixels. The nearest stored pixel is taken: depths of two surfaces are never mixed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from recordings.cameras.pinhole import UnusableCamera
from recordings.types import NO_RETURN, CameraIntrinsics

Points = NDArray[np.float64]
Distort = Callable[[Points, Points, Sequence[float]], tuple[Points, Points]]


_LEAST_INSIDE = 0.05
"""Share of the image that has to be left: coefficients of another model leave next to nothing."""


class Undistortion:
    """Moves the pixels of an image to where a pinhole camera sees them.

    Args:
        intrinsics: the pinhole camera.
        model: the distortion model of the stored image as ROS names it.
        coefficients: its coefficients; zeros where the stored image is a pinhole camera's too.
        stored: the intrinsics of the stored image, of the same size, where they are others.

    Raises:
        UnusableCamera: the model is not known, a coefficient means nothing, or hardly a pixel is left.
    """

    def __init__(
        self,
        intrinsics: CameraIntrinsics,
        model: str,
        coefficients: Sequence[float],
        stored: CameraIntrinsics | None = None,
    ) -> None:
        check_distortion(model, coefficients)
        stored = stored or intrinsics
        width, height = intrinsics.width, intrinsics.height
        u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
        distort = distortion_model(model) if is_distorted(coefficients) else _brown_conrady
        with np.errstate(all="ignore"):  # a rational model may have poles far outside the image
            distorted_x, distorted_y = distort(x, y, coefficients)
            limit = unfolded_radius(distort, coefficients, float(np.hypot(x, y).max()))
        column = np.rint(distorted_x * stored.fx + stored.cx)
        row = np.rint(distorted_y * stored.fy + stored.cy)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (np.hypot(x, y) < limit)
        self._source = np.where(inside, row * width + column, 0).astype(np.intp)
        self._outside = ~inside
        if inside.mean() < _LEAST_INSIDE:
            raise UnusableCamera(
                f"its camera's distortion leaves {inside.mean():.0%} of the image; "
                "record rectified depth or give --intrinsics fx,fy,cx,cy"
            )

    def depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """The undistorted depth image (H, W); `NO_RETURN` where the stored one does not reach."""
        undistorted = np.take(depth_m, self._source)
        undistorted[self._outside] = NO_RETURN
        return undistorted

    def colour(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The undistorted colour image (H, W, 3); black where the stored one does not reach."""
        undistorted = rgb.reshape(-1, 3)[self._source]
        undistorted[self._outside] = 0
        return undistorted


def distortion_model(name: str) -> Distort:
    """Where a lens moves points (x, y) of the plane z = 1, by the model's name in ROS.

    Raises:
        UnusableCamera: the model is not known.
    """
    if name not in _MODELS:
        raise UnusableCamera(
            f"its camera has the distortion model {name!r}, known are {', '.join(sorted(_MODELS))}; "
            "record rectified images or give --intrinsics fx,fy,cx,cy"
        )
    return _MODELS[name]


def check_distortion(model: str, coefficients: Sequence[float]) -> None:
    """Raise UnusableCamera unless the coefficients are those of a known model."""
    advice = "record rectified depth or give --intrinsics fx,fy,cx,cy"
    if not is_distorted(coefficients):
        return
    known = _COEFFICIENTS[distortion_model(model)]
    if not np.isfinite(coefficients).all():
        raise UnusableCamera(f"its camera's distortion is not finite; {advice}")
    if is_distorted(coefficients[known:]):
        raise UnusableCamera(
            f"its camera's distortion has {len(coefficients)} coefficients, of which {known} are known here "
            f"({model}); {advice}"
        )


def is_distorted(coefficients: Sequence[float]) -> bool:
    """Whether the coefficients do anything."""
    return any(value != 0 for value in coefficients)


def _brown_conrady(x: Points, y: Points, coefficients: Sequence[float]) -> tuple[Points, Points]:
    """plumb_bob and rational_polynomial: OpenCV's pinhole model with up to 12 coefficients.

    Order k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 (OpenCV, "Camera Calibration and 3D Reconstruction").
    """
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = (*coefficients, *[0.0] * 12)[:12]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    distorted_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2)
    distorted_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4)
    return distorted_x, distorted_y


def _equidistant(x: Points, y: Points, coefficients: Sequence[float]) -> tuple[Points, Points]:
    """Fisheye: theta_d = theta (1 + k1 theta^2 + ... + k4 theta^8) (Kannala and Brandt 2006, OpenCV)."""
    k1, k2, k3, k4 = (*coefficients, *[0.0] * 4)[:4]
    r = np.hypot(x, y)
    t = np.arctan(r)
    t2 = t * t
    bent = t * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    scale = np.divide(bent, r, out=np.ones_like(r), where=r > 1e-12)
    return x * scale, y * scale


def unfolded_radius(distort: Distort, coefficients: Sequence[float], largest: float) -> float:
    """Up to where the model pushes outer rays outwards; beyond, it folds back over the image."""
    radii = np.linspace(0.0, largest, 2048)
    reached, _ = distort(radii, np.zeros_like(radii), coefficients)
    falling = np.flatnonzero(np.diff(reached) <= 0)
    return float(radii[falling[0]]) if falling.size else np.inf


_MODELS: dict[str, Distort] = {
    "plumb_bob": _brown_conrady,
    "brown_conrady": _brown_conrady,
    "rational_polynomial": _brown_conrady,
    "equidistant": _equidistant,
    "fisheye": _equidistant,
    "kannala_brandt": _equidistant,
    "kannala_brandt4": _equidistant,
}
_COEFFICIENTS: dict[Distort, int] = {_brown_conrady: 12, _equidistant: 4}
"""How many a model has; OpenCV's 13th and 14th of the first tilt the sensor."""
