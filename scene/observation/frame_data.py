"""What one frame gives to the search: view, masks, windows, background, support plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics
from scene.observation.depth_view import PooledView
from scene.observation.detection import SupportPlane
from scene.observation.pixel_window import PixelWindow


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneData:
    """One frame, prepared.

    Attributes:
        view: pooled image.
        foreground: (H, W) bool, the view's pixels that may show an object.
        compact: (H, W) bool, those of them whose piece looks like a whole thing: there the search begins.
        window: the pixels on which scenes are compared.
        window_foreground: its pixels that may show an object.
        support_m: the window's depth of the nearest support; +inf beside all.
        rest_m: the same, but what was seen where no object may be.
        supports: planes on which objects can stand, that which carries most first.
        intrinsics: of the image.
        depth_m: the whole image.
        near: (H, W) bool, the image's pixels that may show an object.
        rgb, rgb_known: as `Frame`, where colours are compared too; else None.
    """

    view: PooledView
    foreground: NDArray[np.bool_]
    compact: NDArray[np.bool_]
    window: PixelWindow
    window_foreground: NDArray[np.bool_]
    support_m: NDArray[np.float32]
    rest_m: NDArray[np.float32]
    supports: tuple[SupportPlane, ...]
    intrinsics: CameraIntrinsics
    depth_m: NDArray[np.float32]
    near: NDArray[np.bool_]
    rgb: NDArray[np.uint8] | None = None
    rgb_known: NDArray[np.bool_] | None = None

    @property
    def table(self) -> SupportPlane | None:
        """The support that carries most; None where nothing supports the objects."""
        return self.supports[0] if self.supports else None
