"""Segmentation of a frame: pixels that may show an object, and the background behind them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, label, maximum_filter, median_filter, minimum_filter

from recordings.types import NO_RETURN, CameraIntrinsics
from scene.observation.depth_view import PooledView, pixels_at, pooled_view, unproject
from scene.observation.detection import SupportPlane, as_seen, given_support, joined, support_planes
from scene.observation.frame_data import SceneData
from scene.observation.pixel_window import PixelWindow, window_of
from scene.observation.standing import HIGHEST_M, LOWEST_M, MARGIN_M, is_over, pieces_on
from shapes.geometry.poses import transform_points

VIEW_WIDTH = 320

WARP_M, STEP_M, LEVEL_COSINE, SMOOTHED_PX = 0.02, 0.004, 0.9, 5
"""A table may be warped so far; steps this high and slopes are the sides of things on it."""

BEHIND_M = 0.03
"""What is measured so far behind a support's plane, which may be warped, is seen past its edge."""

UNSEEN_M = 0.2
"""A table that the image cuts off may go on so far."""

SEEN_SHARE = 0.6
"""Of a table's rectangle that nothing hides; a round one shows 79%."""

FARTHEST_M = 2.5
"""From the camera: objects are looked for up to here."""

FEWEST_PIXELS = 100


def shows_enough(depth_m: NDArray[np.float32]) -> bool:
    """Whether a depth image (H, W) can be parsed."""
    return bool(_near(depth_m).sum() >= FEWEST_PIXELS)


def near_share(depth_m: NDArray[np.float32]) -> float:
    """Share of a depth image's returns (H, W) that lie where objects are looked for."""
    return float(_near(depth_m).sum() / max((depth_m != NO_RETURN).sum(), 1))


def scene_data(
    depth_m: NDArray[np.float32],
    intrinsics: CameraIntrinsics,
    seed: int,
    support: tuple[float, ...] = (),
    region: tuple[float, ...] = (),
) -> SceneData:
    """The supports, the foreground and the background of a depth image (H, W), as `scene_views`."""
    return scene_views([depth_m], np.eye(4)[None], intrinsics, seed, support, region)[0]


def scene_views(
    depths_m: Sequence[NDArray[np.float32]],
    first_camera_from_camera: NDArray[np.float64],
    intrinsics: CameraIntrinsics,
    seed: int,
    support: tuple[float, ...] = (),
    region: tuple[float, ...] = (),
) -> list[SceneData]:
    """Depth images of a scene at rest, all with the supports that any of them shows.

    A support reaches as far as all images together show it. Each camera bends it in its own way.

    Args:
        depths_m: F images (H, W).
        first_camera_from_camera: (F, 4, 4) poses relative to the first of them.
        intrinsics: of the images.
        seed: of the random samples.
        support: a point and the normal of the one support, metres in the first camera's frame; found by
            itself where it is empty.
        region: least and greatest x, y, z in that frame between which objects are looked for; everywhere
            where it is empty.

    Raises:
        ValueError: nothing is in front of any camera, in the region or on the support.
    """
    showing = [number for number, one in enumerate(depths_m) if shows_enough(one)]
    if not showing:
        raise ValueError(f"fewer than {FEWEST_PIXELS} pixels were measured within {FARTHEST_M} m")
    images = [_Image.of(one, intrinsics) for one in depths_m]
    supports: list[SupportPlane] = []
    for number in showing:
        image, pose = images[number], first_camera_from_camera[number]
        if support and number != showing[0]:  # it goes on as far as this image shows it
            others = [replace(supports[0], half_size_m=np.full(2, FARTHEST_M))]
        else:
            own = _supports_of(image, seed, _seen_from(pose, support), region if number == 0 else ())
            others = [_in_camera(one, pose) for one in own]
        supports = joined(supports, others, transform_points(pose, image.near_m))
    views = []
    for number, (image, pose) in enumerate(zip(images, first_camera_from_camera, strict=True)):
        mine = [_in_camera(one, np.linalg.inv(pose)) for one in supports]
        if number != showing[0]:
            mine = [as_seen(one, image.near_m) for one in mine]
        views.append(_data_over(mine, image, intrinsics, region, pose))
    if region and not any(one.near.any() for one in views):
        raise ValueError("nothing stands in the region that was given")
    return views


@dataclass(frozen=True, kw_only=True, eq=False)
class _Image:
    """A depth image (H, W), its points (H, W, 3) in the camera, its pooled view, and near points (N, 3)."""

    depth_m: NDArray[np.float32]
    points_m: NDArray[np.float64]
    view: PooledView
    near_m: NDArray[np.float64]

    @classmethod
    def of(cls, depth_m: NDArray[np.float32], intrinsics: CameraIntrinsics) -> _Image:
        """Of a camera."""
        points_m = unproject(depth_m, intrinsics)
        view = pooled_view(depth_m, intrinsics, VIEW_WIDTH)
        return cls(depth_m=depth_m, points_m=points_m, view=view, near_m=points_m[_near(depth_m)])


def _supports_of(
    image: _Image, seed: int, support: tuple[float, ...], region: tuple[float, ...]
) -> list[SupportPlane]:
    """The supports that one image shows, in its camera's frame, that on which most stands first."""
    if support:
        supports = [given_support(np.array(support[:3]), np.array(support[3:]), image.near_m)]
    else:
        supports = support_planes(image.near_m, seed, partial(_is_seen, image.view))
        supports = _busiest_first(supports, image.view, region)
    return [_continued(one, image.view) for one in supports]


def _seen_from(first_from_camera: NDArray[np.float64], support: tuple[float, ...]) -> tuple[float, ...]:
    """A point and a normal of the first camera's frame in that of another; nothing of nothing."""
    if not support:
        return ()
    rotation, origin = first_from_camera[:3, :3], first_from_camera[:3, 3]
    return tuple(np.concatenate([(support[:3] - origin) @ rotation, support[3:] @ rotation]).tolist())


def _in_camera(support: SupportPlane, camera_from_other: NDArray[np.float64]) -> SupportPlane:
    """The support of another camera in this one's frame."""
    return replace(support, camera_from_table=camera_from_other @ support.camera_from_table)


def support_depth(
    supports: Sequence[SupportPlane], window: PixelWindow, intrinsics: CameraIntrinsics
) -> NDArray[np.float32]:
    """Depth (H, W) of the nearest support in a window's pixels, +inf beside all.

    A support over another one is a body with sides down to it, if most pixels that could see these do; a
    shelf is none. Its edge is where they begin. Sides stay foreground: they are known to a centimetre or two.
    A support reaches as far as it is seen: where something behind its surface is measured it is not.
    """
    nearest_m = np.full(window.depth_m.shape, np.inf)
    rays = intrinsics.rays(window.columns[None, :], window.rows[:, None])
    for support in supports:
        side_m = _side_depth(support, height_over_next(support, supports), rays)
        has_sides = _is_mostly_shown(side_m, window.depth_m)
        wide_m = _plane_depth(support, rays, MARGIN_M)
        surfaces = [(wide_m, BEHIND_M)]
        if has_sides:
            seen_m = np.where(window.depth_m == NO_RETURN, np.inf, wide_m)
            surfaces = [(_plane_depth(support, rays, 0.0), BEHIND_M), (seen_m, LOWEST_M), (side_m, BEHIND_M)]
        for depth_m, behind_m in surfaces:
            is_there = window.depth_m <= depth_m + behind_m
            nearest_m = np.where(is_there, np.minimum(nearest_m, depth_m), nearest_m)
    return nearest_m.astype(np.float32)


def _data_over(
    supports: Sequence[SupportPlane],
    image: _Image,
    intrinsics: CameraIntrinsics,
    region: tuple[float, ...],
    first_from_camera: NDArray[np.float64],
) -> SceneData:
    depth_m, points, view = image.depth_m, image.points_m, image.view
    factor = max(1, round(intrinsics.width / VIEW_WIDTH))
    foreground = _near(depth_m)
    if region:
        foreground &= _within(region, transform_points(first_from_camera, points))
    compact = np.ones(view.depth_m.shape, bool)
    if supports:
        surface = _surface_of_any(supports, view)
        pieces = pieces_on(supports, view.points_m, surface)
        elsewhere, compact = (pieces.things_on(range(first, len(supports))) for first in (1, 0))
        foreground &= is_over(supports[0], points) | _enlarged(elsewhere, factor, foreground.shape)
        foreground &= ~_enlarged(surface, factor, foreground.shape)
    pooled_foreground = _pooled_any(foreground, factor, view.depth_m.shape) & (np.asarray(view.depth_m) > 0)
    window = window_of(depth_m, intrinsics)
    support_m = support_depth(supports, window, intrinsics)
    no_object = ~window.of(foreground) & (window.depth_m != NO_RETURN)
    return SceneData(
        view=replace(view, unexplained=jax.device_put(pooled_foreground)),
        foreground=pooled_foreground,
        compact=pooled_foreground & compact,
        window=window,
        window_foreground=np.asarray(binary_dilation(window.of(foreground), iterations=2), bool),
        support_m=support_m,
        rest_m=np.where(no_object, window.depth_m, support_m),
        supports=tuple(supports),
        intrinsics=intrinsics,
        depth_m=depth_m,
        near=foreground,
    )


def _is_seen(view: PooledView, table: SupportPlane) -> bool:
    """Whether most of what nothing hides of the table's rectangle shows the table.

    A plane that cuts through things that hang in the air lets most of what is behind it be seen.
    """
    observed_m = np.asarray(view.depth_m)
    plane_m = _plane_depth(table, unproject(np.ones_like(observed_m), view.camera), 0.0)
    shows = (observed_m != NO_RETURN) & (np.abs(table.in_table_frame(view.points_m)[..., 2]) < WARP_M)
    hidden = (observed_m != NO_RETURN) & (observed_m < plane_m) & ~shows
    expected = np.isfinite(plane_m) & ~hidden
    return bool((shows & expected).sum() > SEEN_SHARE * expected.sum())


def _plane_depth(table: SupportPlane, rays: NDArray[np.float64], margin_m: float) -> NDArray[np.float64]:
    """Depth (...) of the table, as seen, along rays (..., 3) of unit depth, +inf beyond its rectangle."""
    normal, origin = table.camera_from_table[:3, 2], table.camera_from_table[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray along the table does not meet it
        depth = (normal @ origin) / (rays @ normal)
        bend_m = -table.heights(rays * depth[..., None])  # of the plane under the surface that is seen
        depth = (normal @ origin + bend_m) / (rays @ normal)
        inside = table.in_table_frame(rays * depth[..., None])
    return np.where((depth > 0) & table.covers(inside, margin_m), depth, np.inf)


def _is_mostly_shown(surface_m: NDArray[np.float64], observed_m: NDArray[np.float32]) -> bool:
    """Whether most pixels that look at a surface (H, W), and at nothing before it, show it."""
    looks = np.isfinite(surface_m) & (observed_m != NO_RETURN) & (observed_m > surface_m - WARP_M)
    return bool((observed_m[looks] < surface_m[looks] + WARP_M).sum() > SEEN_SHARE * looks.sum())


def height_over_next(table: SupportPlane, supports: Sequence[SupportPlane]) -> float:
    """Metres of a support over the next one below; +inf of those that are over none."""
    heights_m = [np.inf]
    for below in supports:
        middle_m = below.in_table_frame(table.camera_from_table[:3, 3])
        if middle_m[2] > LOWEST_M and below.covers(middle_m):
            heights_m.append(middle_m[2])
    return min(heights_m)


def _side_depth(table: SupportPlane, height_m: float, rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depth (...) of the sides of what carries things so high, along rays (..., 3) of unit depth.

    +inf beside them; all +inf if the height is.
    """
    if np.isinf(height_m):
        return np.full(rays.shape[:-1], np.inf)
    high = np.append(table.half_size_m, 0.0)
    low = np.append(-table.half_size_m, -height_m)
    towards, camera = rays @ table.camera_from_table[:3, :3], table.in_table_frame(np.zeros(3))
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray in the plane of a side is beside it
        ends = np.stack([(low - camera) / towards, (high - camera) / towards])
    enters, leaves = ends.min(axis=0), ends.max(axis=0)
    depth_m = enters.max(axis=-1)
    by_side = (enters.argmax(axis=-1) != 2) & (depth_m > 0) & (depth_m < leaves.min(axis=-1))
    return np.where(by_side, depth_m, np.inf)


def _near(depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    return (depth_m != NO_RETURN) & (depth_m < FARTHEST_M)


def _continued(table: SupportPlane, view: PooledView) -> SupportPlane:
    """The table, going on beyond the image under what is seen at the border and has its foot out of sight."""
    points_m = view.points_m[_near(np.asarray(view.depth_m))]
    inside = table.in_table_frame(points_m)
    round_it = table.covers(inside, UNSEEN_M)
    heights = table.heights(points_m[round_it])
    feet = inside[round_it, :2][(heights > LOWEST_M) & (heights < HIGHEST_M)]
    rotation, origin = table.camera_from_table[:3, :3], table.camera_from_table[:3, 3]
    in_camera = feet @ rotation[:, :2].T + origin
    feet = feet[~pixels_at(in_camera, view.camera, view.depth_m.shape)[2]]
    if len(feet) < FEWEST_PIXELS:
        return table
    half = table.half_size_m
    return table.spanning(np.minimum(feet.min(axis=0), -half), np.maximum(feet.max(axis=0), half))


def _within(region: tuple[float, ...], points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (H, W, 3) of the first camera's frame lie in the region."""
    low, high = np.reshape(region, (2, 3))
    return np.asarray(((points_m >= low) & (points_m <= high)).all(axis=-1))


def _busiest_first(
    supports: list[SupportPlane], view: PooledView, region: tuple[float, ...]
) -> list[SupportPlane]:
    """The supports, that on which most stands first: not the floor for what stands on a table over it."""
    if len(supports) < 2:
        return supports
    left_out = _surface_of_any(supports, view)
    if region:
        left_out |= ~_within(region, view.points_m)
    carried = pieces_on(supports, view.points_m, left_out).carried(len(supports))
    return [supports[number] for number in np.argsort(-carried, kind="stable")]


def _surface_of_any(supports: Sequence[SupportPlane], view: PooledView) -> NDArray[np.bool_]:
    """Pixels (H, W) of any support's surface."""
    points = unproject(median_filter(np.asarray(view.depth_m), SMOOTHED_PX), view.camera)
    return np.any([_surface_of(one, points, np.asarray(view.normals)) for one in supports], axis=0)


def _surface_of(
    table: SupportPlane, points: NDArray[np.float64], normals: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Pixels (H, W) reached from the table's plane without a step or a slope, though it be warped.

    Args:
        table: the support.
        points: (H, W, 3) of smoothed depth.
        normals: (H, W, 3).
    """
    depth = points[..., 2]
    inside = table.covers(table.in_table_frame(points), UNSEEN_M)
    heights = np.where((depth > 0) & inside, table.heights(points), np.inf)
    upward = normals @ table.camera_from_table[:3, 2]
    low = np.abs(heights) < WARP_M
    level = np.where(low, heights, 0.0)
    even = maximum_filter(level, 3) - minimum_filter(level, 3) < STEP_M
    parts = np.zeros(depth.shape, np.int32)
    if not label(low & even & (upward > LEVEL_COSINE), output=parts):
        return np.zeros(depth.shape, bool)
    flat = np.abs(heights) < LOWEST_M
    share = np.bincount(parts.ravel(), flat.ravel()) / np.maximum(np.bincount(parts.ravel()), 1)
    share[0] = 0
    return np.asarray(binary_dilation(share[parts] > 0.5), bool)


def _enlarged(mask: NDArray[np.bool_], factor: int, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """A pooled mask in the pixels of the image, False beyond."""
    large = np.zeros(shape, bool)
    blocks = mask.repeat(factor, axis=0).repeat(factor, axis=1)[: shape[0], : shape[1]]
    large[: blocks.shape[0], : blocks.shape[1]] = blocks
    return large


def _pooled_any(mask: NDArray[np.bool_], factor: int, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    rows, columns = shape
    blocks = mask[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor)
    return blocks.mean(axis=(1, 3)) >= 0.25
