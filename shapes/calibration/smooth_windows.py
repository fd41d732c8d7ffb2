"""Small windows of a depth image, each with the residuals about the smooth surface that fits it best.

On a plane inverse depth is linear in the pixel's place; a quadratic follows what bends as well. Windows that
show no one surface have large residuals: which those are is told by all windows together
(`shapes.calibration.noise_estimate`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from recordings.types import NO_RETURN, CameraIntrinsics

WINDOW_RAD = 1 / 14
"""Angle across a window: 7 cm at 1 m, as large as objects are smooth. What errs more slowly over the image
than this is the surface's shape to whoever looks at one image, or the distortion field's."""
LEAST_PX, MOST_PX = 16, 96
LEAST_USED = 0.8
"""Share of a window's pixels that show its surface, at least."""
ISOLATED = 0.03
"""A return that differs by this share from all around it is of no surface: an outlier."""
TRIMMINGS, TRIMMED = 2, 4.0
"""Times that returns so many deviations off the surface are left out; a Gaussian has 6e-5 of those."""
LAGS = 8
"""Pixels over which correlations are looked at."""
COEFFICIENTS = 6
LARGEST_HOLE = 0.01
"""Share of the image: a larger hole may be a window pane, or what is out of range."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WindowResiduals:
    """The windows of some images, and their returns.

    Attributes:
        side_px: of the windows.
        depth_m: (n,) of their middles.
        square_m2: (n,) mean squared residual.
        correlation: (n, 2, LAGS) of residuals 1, 2, ... pixels apart along rows and columns, biased by the
            fit as `shapes.calibration.residual_correlation` foretells.
        returned: (n,) pixels that returned.
        off: (n,) of these, outliers.
        holes: pixels of small holes within what was measured.
        measured: pixels that returned in all the images.
        farthest_m: largest return that is no outlier.
    """

    side_px: int
    depth_m: NDArray[np.float64]
    square_m2: NDArray[np.float64]
    correlation: NDArray[np.float64]
    returned: NDArray[np.int64]
    off: NDArray[np.int64]
    holes: int
    measured: int
    farthest_m: float

    @classmethod
    def of(cls, depth_m: NDArray[np.float32], intrinsics: CameraIntrinsics) -> WindowResiduals:
        """Those of one image (H, W) that show one surface, as far as it tells."""
        side = int(np.clip(round(intrinsics.fx * WINDOW_RAD), LEAST_PX, MOST_PX))
        isolated = _isolated(depth_m)
        windows, alone = _cut(depth_m, side), _cut(isolated, side)
        returned, usable = windows != NO_RETURN, (windows != NO_RETURN) & ~alone
        enough = usable.mean(axis=1) >= LEAST_USED
        windows, returned, usable = windows[enough].astype(np.float64), returned[enough], usable[enough]
        residual_m, used, middle_m = _fitted(windows, usable, side)
        kept = (used.mean(axis=1) >= LEAST_USED) & np.isfinite(middle_m)
        residual_m, used = residual_m[kept].reshape(-1, side, side), used[kept].reshape(-1, side, side)
        square = (residual_m**2).sum(axis=(1, 2)) / used.sum(axis=(1, 2)).clip(1)
        good = depth_m[(depth_m != NO_RETURN) & ~isolated]
        return cls(
            side_px=side,
            depth_m=middle_m[kept],
            square_m2=square,
            correlation=_correlation(residual_m, used, square),
            returned=returned[kept].sum(axis=1),
            off=(returned & alone[enough])[kept].sum(axis=1),
            holes=_holes(depth_m),
            measured=int((depth_m != NO_RETURN).sum()),
            farthest_m=float(good.max(initial=0.0)),
        )

    @classmethod
    def together(cls, parts: list[WindowResiduals]) -> WindowResiduals:
        """The windows of several images of one camera."""
        counts = {"holes", "measured", "farthest_m", "side_px"}
        arrays = {
            field.name: np.concatenate([getattr(one, field.name) for one in parts])
            for field in fields(cls)
            if field.name not in counts
        }
        return cls(
            side_px=parts[0].side_px,
            **arrays,
            holes=sum(one.holes for one in parts),
            measured=sum(one.measured for one in parts),
            farthest_m=max(one.farthest_m for one in parts),
        )


def quadratic_basis(side: int) -> NDArray[np.float64]:
    """Orthonormal quadratics (side^2, COEFFICIENTS) over the pixels of a window."""
    steps = (np.arange(side) - (side - 1) / 2) / side
    x, y = (part.ravel() for part in np.meshgrid(steps, steps))
    return np.linalg.qr(np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1))[0]


def _fitted(
    windows_m: NDArray[np.float64], usable: NDArray[np.bool_], side: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.float64]]:
    """Residuals (n, side^2) in metres, 0 where a pixel is left out; which are used; middles' depths (n,)."""
    inverse, used = 1 / np.where(usable, windows_m, 1.0), usable
    surface = _quadratic(inverse, used, side)
    for _ in range(TRIMMINGS):
        error = np.abs(inverse - surface)
        used = usable & (error < TRIMMED * _spread(error, usable))
        surface = _quadratic(inverse, used, side)
    depth_m = 1 / np.where(surface > 0, surface, np.nan)
    residual_m = np.where(used, (surface - inverse) * depth_m * windows_m, 0.0)  # z - d = z d (1/d - 1/z)
    middle_m = depth_m.reshape(-1, side, side)[:, side // 2, side // 2]
    return residual_m, used, np.where(np.isfinite(residual_m).all(axis=1), middle_m, np.nan)


def _quadratic(inverse: NDArray[np.float64], used: NDArray[np.bool_], side: int) -> NDArray[np.float64]:
    """The quadratics (n, side^2) nearest to the used ones of inverse depths (n, side^2)."""
    basis = quadratic_basis(side)
    products = (basis[:, :, None] * basis[:, None, :]).reshape(side**2, -1)
    normal = (used @ products).reshape(-1, COEFFICIENTS, COEFFICIENTS) + 1e-9 * np.eye(COEFFICIENTS)
    return np.linalg.solve(normal, ((used * inverse) @ basis)[..., None])[..., 0] @ basis.T


def _spread(error: NDArray[np.float64], usable: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Standard deviation (n, 1) of absolute errors (n, side^2) by the median of the usable ones."""
    if not len(error):
        return np.zeros((0, 1))
    ordered = np.sort(np.where(usable, error, np.inf).astype(np.float32), axis=1)
    middle = np.take_along_axis(ordered, usable.sum(axis=1, keepdims=True) // 2, axis=1)
    return np.maximum(middle / 0.6745, 1e-9)


def _correlation(
    residual_m: NDArray[np.float64], used: NDArray[np.bool_], square_m2: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(n, 2, LAGS) of residuals (n, side, side) of that mean square (n,)."""
    along = []
    for axis in (2, 1):
        value, use = np.moveaxis(residual_m, axis, 2), np.moveaxis(used, axis, 2).astype(np.float32)
        for lag in range(1, LAGS + 1):
            pairs = (use[..., lag:] * use[..., :-lag]).sum(axis=(1, 2)).clip(1)
            along.append((value[..., lag:] * value[..., :-lag]).sum(axis=(1, 2)) / pairs)
    found = np.stack(along, axis=1) if len(residual_m) else np.zeros((0, 2 * LAGS))
    return (found / np.maximum(square_m2, 1e-30)[:, None]).reshape(-1, 2, LAGS)


def _isolated(depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Returns (H, W) that agree with none of the eight around them."""
    wide = np.pad(depth_m, 1, constant_values=NO_RETURN)
    height, width = depth_m.shape
    nearest = np.full(depth_m.shape, np.inf, np.float32)
    for place in range(9):
        if place != 4:
            row, column = divmod(place, 3)
            beside = wide[row : row + height, column : column + width]
            nearest = np.minimum(nearest, np.abs(beside - depth_m))
    return (depth_m != NO_RETURN) & (nearest > ISOLATED * depth_m)


def _holes(depth_m: NDArray[np.float32]) -> int:
    """Pixels of small holes off the image's border: rays that met something and did not return."""
    numbers = np.zeros(depth_m.shape, np.int32)
    label(depth_m == NO_RETURN, output=numbers)
    sizes = np.bincount(numbers.ravel())
    inside = np.ones(len(sizes), bool)
    inside[0] = False
    for side in (numbers[0], numbers[-1], numbers[:, 0], numbers[:, -1]):
        inside[side] = False
    return int(sizes[inside & (sizes <= LARGEST_HOLE * depth_m.size)].sum())


def _cut(image: NDArray, side: int) -> NDArray:
    """The windows (n, side^2) of an image, in its middle, side by side."""
    rows, columns = (size // side * side for size in image.shape)
    first = (image.shape[0] - rows) // 2, (image.shape[1] - columns) // 2
    middle = image[first[0] : first[0] + rows, first[1] : first[1] + columns]
    return middle.reshape(rows // side, side, columns // side, side).swapaxes(1, 2).reshape(-1, side**2)
