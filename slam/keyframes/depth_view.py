"""Images of a frame on canvases of fixed size: the working image of the filter, and a finer one.

Depth is averaged over square blocks; one canvas a kind serves recordings of every size, so that kernels are
compiled once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache, partial, reduce
from operator import add

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN, CameraIntrinsics, Frame
from shapes.geometry.camera import Camera, pixel_rays

CANVAS_HEIGHT = 120
"""Working resolution, the supplement's 160 x 120."""

CANVAS_WIDTH = 160

CANVAS = (CANVAS_HEIGHT, CANVAS_WIDTH)

FINE_CANVAS = (240, 320)
"""Rows and columns of the image that refinement of the keyframes looks at."""

ONE_SURFACE_BAND = 0.03
"""Relative depth within which the pixels of a block, or the elements of several keyframes, are one surface,
and behind which a keyframe saw through the space in front."""

LEAST_RETURNS = 0.01
"""Share of the pixels that must have returned for a view to begin a map, or to be sought anywhere in one."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CanvasView:
    """One frame on a canvas (H, W).

    Attributes:
        depth_m: (H, W) float32 along the optical axis, `NO_RETURN` where unknown.
        measured: (H, W) bool, the pixels that the image has (the canvas may be larger).
        rays: (3, H, W) directions through the pixel centres, scaled to z = 1.
        camera: intrinsics on the canvas.
    """

    depth_m: jax.Array
    measured: jax.Array
    rays: jax.Array
    camera: Camera

    def lattice(self, stride_px: int, first: int = 0) -> tuple[jax.Array, jax.Array]:
        """Depth (n,) and rays (3, n) of every so many of its pixels in both directions."""
        every = slice(first, None, stride_px)
        return self.depth_m[every, every].ravel(), self.rays[:, every, every].reshape(3, -1)


def shows_enough(view: CanvasView) -> bool:
    """Whether a view begins a map or is worth a search: sensors give images of (next to) nothing, too."""
    measured = np.asarray(view.measured)
    returns = (np.asarray(view.depth_m) != NO_RETURN) & measured
    return bool(returns.sum() > LEAST_RETURNS * measured.sum())


def framing(view: CanvasView) -> NDArray[np.float64]:
    """What the view's image takes in (6,): fx, fy, cx, cy, columns, rows, in pixels."""
    camera, measured = view.camera, np.asarray(view.measured)
    rows, columns = measured[:, 0].sum(), measured[0].sum()
    return np.asarray([camera.fx, camera.fy, camera.cx, camera.cy, columns, rows], float)


def central_depth(view: CanvasView) -> float:
    """Median depth of the image's middle ninth, or of all of it, or 1 m where nothing was measured."""
    depth_m = np.asarray(view.depth_m)
    rows, columns = depth_m.shape
    middle = depth_m[rows // 3 : 2 * rows // 3, columns // 3 : 2 * columns // 3]
    for region in (middle, depth_m):
        if (region > 0).any():
            return float(np.median(region[region > 0]))
    return 1.0


def farthest_depth(view: CanvasView) -> float:
    """Of its returns; 0 where nothing was measured."""
    return float(np.asarray(view.depth_m).max())


def view_of_frame(frame: Frame, intrinsics: CameraIntrinsics, canvas: tuple[int, int] = CANVAS) -> CanvasView:
    """A frame on a canvas of (rows, columns); one of another size than `intrinsics` is taken as resized."""
    height, width = frame.depth_m.shape
    if (height, width) != (intrinsics.height, intrinsics.width):
        intrinsics = intrinsics.resized(width, height)
    factor = max(1, -(-height // canvas[0]), -(-width // canvas[1]))  # side of blocks averaged to a pixel
    rows, columns = -(-height // factor), -(-width // factor)
    padded: NDArray[np.float32] = np.full((rows * factor, columns * factor), NO_RETURN, np.float32)
    padded[:height, :width] = frame.depth_m
    whole_blocks = replace(intrinsics, width=columns * factor, height=rows * factor)
    blank = _blank(whole_blocks.resized(columns, rows), canvas)
    return replace(blank, depth_m=_reduced(padded, factor, canvas))


@lru_cache(maxsize=16)
def _blank(intrinsics: CameraIntrinsics, canvas: tuple[int, int]) -> CanvasView:
    """A view of nothing: its rays are in memory once, for all frames of a camera."""
    camera = Camera.from_intrinsics(intrinsics)
    padding = ((0, canvas[0] - intrinsics.height), (0, canvas[1] - intrinsics.width))
    return CanvasView(
        depth_m=jnp.full(canvas, NO_RETURN, jnp.float32),
        measured=jnp.pad(jnp.ones((intrinsics.height, intrinsics.width), bool), padding),
        rays=jnp.moveaxis(pixel_rays(camera, *canvas), -1, 0),
        camera=camera,
    )


@partial(jax.jit, static_argnames=("factor", "canvas"))
def _reduced(depth_m: jax.Array, factor: int, canvas: tuple[int, int]) -> jax.Array:
    reduced = block_reduce(depth_m, factor)
    rows, columns = reduced.shape
    return jnp.pad(reduced, ((0, canvas[0] - rows), (0, canvas[1] - columns)))


def block_reduce(depth_m: jax.Array, factor: int) -> jax.Array:
    """Depth (H, W) averaged over `factor` x `factor` blocks, each over its nearest surface alone.

    A block whose nearest surface covers less than half of it has no return: it has no one depth.
    """
    block = [depth_m[row::factor, column::factor] for row in range(factor) for column in range(factor)]
    nearest = reduce(jnp.minimum, [jnp.where(pixel > NO_RETURN, pixel, jnp.inf) for pixel in block])
    farthest = (1.0 + ONE_SURFACE_BAND) * nearest
    on_surface = [(pixel > NO_RETURN) & (pixel <= farthest) for pixel in block]
    count = reduce(add, [member.astype(jnp.int32) for member in on_surface])
    total = reduce(add, [jnp.where(*pair, 0.0) for pair in zip(on_surface, block, strict=True)])
    return jnp.where(2 * count >= factor * factor, total / jnp.maximum(count, 1), NO_RETURN)
