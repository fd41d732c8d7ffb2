"""Support prior of the search: density of the gap between an object's lowest point and what is below it.

A gap to the table, to another box or to observed clutter has the density of gaps in contact; an object that
rests on nothing is anywhere above the table, with the odds of floating. Observed clutter below an object may
support it, though it be none of the objects; its odds are small. An object has a prior against being below
the table's top, where no camera sees it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from recordings.types import NO_RETURN
from scene.execution import FAST_COMPILE
from scene.model.prior import FLOATING_HEIGHT_M, gap_density
from scene.objects.scene_object import SceneObject
from scene.observation.depth_view import PooledView, unproject
from scene.observation.detection import SupportPlane
from scene.search.support_table import SupportTable
from shapes.geometry.poses import matrices_of

UNKNOWN_CARRIER = 0.1
"""Odds of resting on something that is seen but not known against resting on what is. Chosen on five
synthetic tables (docs/model.md, development films) without the shapes of some carriers: 0.5 lost an object
that was only found for what it carries, 0.03 one on something unknown."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Gravity:
    """Parameters of `PosePrior` and `WeightedTrees` that speak of heights."""

    contact_sigma_m: jax.Array | float
    loose_sigma_m: jax.Array | float
    slack_share: jax.Array | float
    floating_weight: jax.Array | float

    def rests(
        self,
        view: PooledView,
        table: SupportPlane | None,
        objects: Sequence[SceneObject],
        poses: NDArray[np.floating],
    ) -> SupportTable:
        """How poses (N, K, 7) camera_from_box and, last, the absent object rest; without a table all do.

        What is beside the table may stand on something else.

        Args:
            view: of the table.
            table: in the camera's frame.
            objects: N.
            poses: of each of them.
        """
        count, places = poses.shape[0], poses.shape[1] + 1
        if table is None:
            return SupportTable.sure(count, places)
        heights_m = np.zeros((count, places), np.float32)
        gaps_m = np.full((count, places, count, places), np.inf, np.float32)
        table_from_box = np.linalg.inv(table.camera_from_table) @ matrices_of(poses)
        undersides_m = _undersides(objects, table_from_box)
        lowest = undersides_m[:, :, 0]
        heights_m[:, :-1] = _heights(table, lowest)
        seen_m = np.full((count, places), np.inf, np.float32)
        hanging = heights_m[:, :-1] > 0
        seen_m[:, :-1][hanging] = gaps_to_seen(view, table, undersides_m[hanging])
        gaps_m[:, :-1, :, :-1] = _gaps(objects, table_from_box, lowest, hanging)
        return _rests(self, heights_m, seen_m, gaps_m)


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _rests(gravity: Gravity, heights_m: jax.Array, seen_m: jax.Array, gaps_m: jax.Array) -> SupportTable:
    """Logs of the densities of gaps, over that of none."""

    def log_gap(gap_m: jax.Array) -> jax.Array:
        return jnp.log(gap_density(gravity, gap_m) / gap_density(gravity, jnp.zeros_like(gap_m)))

    floating = gravity.floating_weight / FLOATING_HEIGHT_M / gap_density(gravity, jnp.zeros_like(heights_m))
    log_unknown = jnp.log(UNKNOWN_CARRIER) + log_gap(seen_m)
    log_alone = jnp.maximum(jnp.maximum(log_gap(heights_m), jnp.log(floating)), log_unknown)
    return SupportTable(log_alone, log_gap(gaps_m))


def _undersides(objects: Sequence[SceneObject], table_from_box: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (N, K, C, 3) of the underside of each pose (N, K, 4, 4), the lowest first."""
    return np.stack(
        [
            undersides(one.points_m @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3])
            for one, poses in zip(objects, table_from_box, strict=True)
        ]
    )


def _heights(table: SupportPlane, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights (...) of points (..., 3) of the table's frame over it; 0 beside and below it."""
    beside = (np.abs(points_m[..., :2]) > table.half_size_m).any(axis=-1)
    in_camera = points_m @ table.camera_from_table[:3, :3].T + table.camera_from_table[:3, 3]
    return np.where(beside, 0.0, np.maximum(table.heights(in_camera), 0.0))


def _gaps(
    objects: Sequence[SceneObject],
    table_from_box: NDArray[np.float64],
    lowest_m: NDArray[np.float64],
    hanging: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Gaps (N, K, N, K) of poses that are `hanging` (N, K) to the tops of others' boxes, +inf beside them.

    The top is looked for below an object's middle and below its lowest point.
    """
    count, places = hanging.shape
    boxes = table_from_box.reshape(-1, 4, 4)
    middles, half = boxes[:, :3, 3], np.repeat([one.half_extents_m for one in objects], places, axis=0)
    owners = np.repeat(np.arange(count), places)
    gaps_m = np.full((count * places, count * places), np.inf, np.float32)
    rows = np.flatnonzero(hanging)
    for foot in (middles[rows, :2], lowest_m.reshape(-1, 3)[rows, :2]):
        near = cdist(foot, middles[:, :2], "sqeuclidean") < (half**2).sum(axis=1)
        child, parent = np.nonzero(near & (owners[rows][:, None] != owners))
        top_m = _top_below(boxes[parent], half[parent], foot[child])
        gap_m = np.abs(lowest_m.reshape(-1, 3)[rows[child], 2] - top_m)
        gaps_m[rows[child], parent] = np.minimum(gaps_m[rows[child], parent], gap_m)
    return gaps_m.reshape(count, places, count, places)


def _top_below(
    boxes: NDArray[np.float64], half_extents_m: NDArray[np.float64], feet_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Height (M,) at which vertical lines through feet (M, 2) leave boxes (M, 4, 4) upwards, or inf."""
    up = boxes[:, 2, :3]
    start = np.einsum("mij,mi->mj", boxes[:, :2, :3], feet_m - boxes[:, :2, 3])
    start -= up * boxes[:, 2, 3, None]
    slope = np.where(np.abs(up) < 1e-9, 1e-9, up)
    far, near = (half_extents_m - start) / slope, (-half_extents_m - start) / slope
    leaves, enters = np.maximum(near, far).min(axis=1), np.minimum(near, far).max(axis=1)
    return np.where(enters < leaves, leaves, np.inf)


UNDERSIDE_M, UNDERSIDE_POINTS = 0.01, 12
"""Surface points so far over the lowest one are an object's underside; so many of them are looked below."""

STEP_M, STEPS = 0.008, 10
"""Between the places below each of them, the first half a step below."""

BEHIND_M = 0.01
"""What is seen so far behind a place leaves it empty."""


def undersides(points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (K, UNDERSIDE_POINTS, 3) of the underside of K poses, the lowest first; it fills up the rest.

    Args:
        points_m: (K, P, 3) surface points in random order; the third axis points up.
    """
    over_m = points_m[..., 2] - points_m[..., 2].min(axis=1, keepdims=True)
    rank = np.where(over_m > 0, np.where(over_m < UNDERSIDE_M, 1, 2), 0)
    first = np.argsort(rank, axis=1, kind="stable")[:, :UNDERSIDE_POINTS]
    low = np.take_along_axis(rank, first, axis=1) < 2
    return np.take_along_axis(points_m, np.where(low, first, first[:, :1])[..., None], axis=1)


def gaps_to_seen(
    view: PooledView, table: SupportPlane, undersides_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Gaps (K,) from the lowest points to the top of the things that are seen where something may carry them.

    +inf where more of what is below is seen to be empty than is hidden by things less high. Those as high
    as the pose may be the object itself, and tell nothing.

    Args:
        view: of the table.
        table: in the camera's frame.
        undersides_m: (K, C, 3) in the table's frame, the lowest point first.
    """
    depth_m, foreground = np.asarray(view.depth_m), np.asarray(view.unexplained)
    heights_m = table.in_table_frame(unproject(depth_m, view.camera))[..., 2]
    down_m = STEP_M * (np.arange(STEPS) + 0.5)
    below_m = undersides_m[:, :, None] - down_m[:, None] * np.array([0.0, 0.0, 1.0])
    in_camera = below_m @ table.camera_from_table[:3, :3].T + table.camera_from_table[:3, 3]
    rows, columns, inside = view.pixels(in_camera)
    seen_m, gaps_m = depth_m[rows, columns], undersides_m[:, :1, None, 2] - heights_m[rows, columns]
    told = inside & (below_m[..., 2] > 0) & (seen_m != NO_RETURN)
    empty = told & (seen_m > in_camera[..., 2] + BEHIND_M)
    carries = told & ~empty & foreground[rows, columns] & (gaps_m > 0)
    top_m = np.where(carries, gaps_m, np.inf).min(axis=(1, 2))
    return np.where(carries.sum(axis=(1, 2)) > empty.sum(axis=(1, 2)), top_m, np.inf)


def log_not_buried(
    table: SupportPlane | None,
    objects: Sequence[SceneObject],
    poses: NDArray[np.floating],
    sigma_m: float,
) -> NDArray[np.float64]:
    """Log prior (N, K) of how deep poses (N, K, 7) camera_from_box reach below the table, half a Gaussian.

    Of a pose that reaches not below it is 0, as it is without a table. What hangs down beside it is not
    below it.

    Args:
        table: in the camera's frame.
        objects: N.
        poses: of each of them.
        sigma_m: by which a table and poses may be wrong.
    """
    if table is None:
        return np.zeros(poses.shape[:2])
    camera_from_box = matrices_of(poses)
    deepest_m = np.empty(poses.shape[:2])
    for number, one in enumerate(objects):
        turn, offset = camera_from_box[number, :, :3, :3], camera_from_box[number, :, None, :3, 3]
        points = one.points_m.astype(np.float64) @ np.swapaxes(turn, 1, 2) + offset
        beside = np.abs(table.in_table_frame(points)[..., :2]) - table.half_size_m
        below_m = np.where((beside < 0).all(axis=-1), -table.heights(points), 0.0)
        deepest_m[number] = below_m.max(axis=1).clip(0)
    return -0.5 * (deepest_m / sigma_m) ** 2
