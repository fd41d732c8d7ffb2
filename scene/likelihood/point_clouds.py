"""The likelihood of whole scenes by point clouds (Gothoskar et al. 2021, section 3.3).

p(Y | Y~) = prod_i ( C / B + (1 - C) / K~ sum_j 1[|y_i - y~_j| <= r] / (4/3 pi r^3) ): every observed point
is an outlier in the volume B or lies uniformly in a ball round one of the K~ rendered points. Base measure:
Lebesgue in cubic metres for each point.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from scene.likelihood.depth_images import DepthLikelihood
from scene.likelihood.render_cache import CandidateScenes
from scene.observation.depth_view import unproject
from scene.observation.frame_data import SceneData
from shapes.geometry.camera import Camera, project
from shapes.rendering.tiles import from_tiles, to_tiles

POINT_WEIGHT = 0.25
"""Effective over actual number of points: neighbours err alike, which this density does not know."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class CloudLikelihood(DepthLikelihood):
    """prod over frames and observed points of the cloud's density, to the power `POINT_WEIGHT`.

    A scene is rendered as for depth images; every pixel that shows something gives a rendered point. The
    points are measured on the search's window, which is coarser, as clouds are thinned before they are
    compared. The density does not factorise over tiles: that of a frame stands in its first.

    Attributes:
        background_m: (X, TILE_PIXELS) depth of what is no object, as it was seen; 0 beyond the image.
        points_m: (F, K, 3) observed, in each frame's camera; z = 0 where nothing was measured.
        cloud: the density's parameters.
        half_width: of the pixel window in which neighbours are counted.
    """

    background_m: jax.Array
    points_m: jax.Array
    cloud: CloudNoise
    half_width: int = field(metadata={"static": True})

    @classmethod
    def over(
        cls,
        images: DepthLikelihood,
        views: Sequence[SceneData],
        *,
        outlier_probability: float,
        radius_m: float,
    ) -> CloudLikelihood:
        """The same frames compared as clouds.

        Args:
            images: of the frames.
            views: one a frame.
            outlier_probability: C, share of points that no surface explains.
            radius_m: r.

        Raises:
            ValueError: a point is as near to the camera as the radius.
        """
        clouds = [unproject(view.window.depth_m, view.window.camera).reshape(-1, 3) for view in views]
        background_m = np.stack([view.rest_m for view in views])
        return cls(
            **vars(images),
            background_m=to_tiles(jnp.asarray(background_m, jnp.float32), 0.0),
            points_m=jnp.asarray(np.stack(clouds), jnp.float32),
            cloud=CloudNoise(
                outlier_probability=jnp.float32(outlier_probability),
                outlier_volume_m3=jnp.float32(max(map(_seen_volume_m3, views))),
                radius_m=jnp.float32(radius_m),
            ),
            half_width=max(_half_width(view, radius_m) for view in views),
        )

    def shown(
        self,
        layers_m: jax.Array,
        frames: jax.Array,  # noqa: ARG002
        objects: jax.Array,  # noqa: ARG002
        poses: jax.Array,  # noqa: ARG002
    ) -> tuple[jax.Array, jax.Array]:
        """The layers as they are: clouds have no pixels beside outlines."""
        return layers_m, jnp.zeros_like(layers_m)

    def weighed(
        self, shown: CandidateScenes, stands: jax.Array, moved: jax.Array, anew: jax.Array
    ) -> jax.Array:
        """Log densities (K, R, X): each frame's in its first tile, 0 in the others.

        Args:
            shown: what the present scene and the others show.
            stands: (K, N) objects that are where they are in the present scene.
            moved: (K, N) those that are not.
            anew: whether the first is to be done too.
        """
        count, draws, tiles = shown.log_tiles.shape
        mine = shown.scene[None] == jnp.arange(count)[:, None]
        changed = jnp.any(moved, axis=1) | (anew & (jnp.arange(count) == 0))

        def one(given: tuple[jax.Array, jax.Array]) -> jax.Array:
            scene, draw = given
            layers_m = jnp.concatenate([shown.present.layers_m[draw], shown.fresh_m[draw]])
            uses = jnp.concatenate([stands[scene], mine[scene]])
            depth_m = jnp.min(jnp.where(uses[:, None, None], layers_m, jnp.inf), axis=0)
            rendered_m = jnp.where(self.background_m > 0, jnp.minimum(depth_m, self.background_m), jnp.inf)
            log_frames = self._log_frames(from_tiles(rendered_m, self.height, self.width))
            first = jnp.zeros((len(log_frames), tiles // len(log_frames)), jnp.float32)
            log_tiles = first.at[:, 0].set(log_frames.astype(jnp.float32)).ravel()
            return jnp.where(changed[scene], log_tiles, shown.log_tiles[scene, draw])

        scene, draw = jnp.divmod(jnp.arange(count * draws), draws)
        return jax.lax.map(one, (scene, draw)).reshape(count, draws, tiles)

    def _log_frames(self, rendered_m: jax.Array) -> jax.Array:
        """Log density (F,) of each frame's cloud given rendered depths (F, H, W)."""

        def frame(given: tuple[Camera, jax.Array, jax.Array]) -> jax.Array:
            camera, points_m, rendered_m = given
            return POINT_WEIGHT * log_density(self.cloud, camera, points_m, rendered_m, self.half_width)

        return jax.lax.map(frame, (self.cameras, self.points_m, rendered_m))


def _seen_volume_m3(view: SceneData) -> float:
    """B: of the pyramid from the camera through the window to its farthest point, where outliers may lie."""
    height, width = view.window.depth_m.shape
    farthest_m = float(view.window.depth_m.max())
    return farthest_m**3 * height * width / float(3 * view.window.camera.fx * view.window.camera.fy)


def _half_width(view: SceneData, radius_m: float) -> int:
    """Pixels of the finer window to each side that hold every neighbour of a point."""
    camera, depth_m = view.window.camera, view.window.depth_m
    height, width = depth_m.shape
    nearest_m = float(depth_m[depth_m > 0].min(initial=np.inf))
    axes = (camera.fx, camera.cx, width), (camera.fy, camera.cy, height)
    return max(
        window_half_width(radius_m, nearest_m, float(focal), max(float(centre), size - float(centre)))
        for focal, centre, size in axes
    )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CloudNoise:
    """Parameters of the point-cloud density.

    Attributes:
        outlier_probability: C, share of observed points that no surface explains.
        outlier_volume_m3: B, where outliers are uniform.
        radius_m: r of the ball round a rendered point.
    """

    outlier_probability: jax.Array | float = 0.01
    outlier_volume_m3: jax.Array | float = 1.0
    radius_m: jax.Array | float = 0.005


def window_half_width(radius_m: float, nearest_m: float, focal_px: float, half_image_px: float) -> int:
    """Pixels to each side within which every rendered point of a ball's radius lies.

    f (tan(a + asin(r / d)) - tan a) at the border of the image, where a ray leans by a, plus half a pixel
    of rounding.

    Args:
        radius_m: r.
        nearest_m: least depth of an observed point.
        focal_px: focal length.
        half_image_px: largest distance of an observed point from the principal point along that axis.

    Raises:
        ValueError: the ball reaches the camera.
    """
    slope = half_image_px / focal_px
    distance = nearest_m * math.hypot(1.0, slope)
    angle = math.atan(slope) + math.asin(min(radius_m / distance, 1.0))
    if radius_m >= distance or angle >= math.pi / 2:
        raise ValueError(f"a ball of {radius_m} m round a point at depth {nearest_m} m reaches the camera")
    return math.ceil(focal_px * (math.tan(angle) - slope) + 0.5)


def log_density(
    noise: CloudNoise, camera: Camera, points_m: jax.Array, rendered_m: jax.Array, half_width: int
) -> jax.Array:
    """Log density () of observed points (K, 3) given a rendered depth image (H, W)."""
    count = neighbour_counts(noise.radius_m, camera, points_m, rendered_m, half_width)
    rendered = jnp.isfinite(rendered_m).sum()
    outlier = jnp.where(rendered > 0, noise.outlier_probability, 1.0)
    ball = 4.0 / 3.0 * jnp.pi * noise.radius_m**3
    inlier = (1.0 - outlier) * count / (jnp.maximum(rendered, 1) * ball)
    density = jnp.log(outlier / noise.outlier_volume_m3 + inlier)
    return jnp.where(points_m[:, 2] > 0, density, 0.0).sum()


def neighbour_counts(
    radius_m: jax.Array | float, camera: Camera, points_m: jax.Array, rendered_m: jax.Array, half_width: int
) -> jax.Array:
    """Rendered points (K,) within the radius of each observed point (K, 3), looked up in a pixel window."""
    height, width = rendered_m.shape
    x, y, z = points_m.T
    depth = jnp.where(z > 0, z, 1.0)
    column, row = (jnp.round(at) for at in project(camera, x, y, depth))
    reach = jnp.arange(-half_width, half_width + 1, dtype=jnp.float32)
    side = len(reach)

    def add(step: jax.Array, count: jax.Array) -> jax.Array:
        u, v = column + reach[step % side], row + reach[step // side]
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        index = jnp.where(inside, v * width + u, 0).astype(jnp.int32)
        there = rendered_m.reshape(-1)[index]
        square = ((u - camera.cx) / camera.fx * there - x) ** 2
        square += ((v - camera.cy) / camera.fy * there - y) ** 2 + (there - z) ** 2
        return count + (inside & jnp.isfinite(there) & (square <= radius_m**2))

    return jax.lax.fori_loop(0, side * side, add, jnp.zeros(len(points_m), jnp.int32))
