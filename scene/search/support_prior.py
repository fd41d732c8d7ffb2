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

from recordings.types import NO_RETURN
from scene.execution import FAST_COMPILE, map_parallel, score_on_all_cores
from scene.model.prior import FLOATING_HEIGHT_M, gap_density
from scene.objects.scene_object import SceneObject
from scene.observation.depth_view import PooledView, pixels_at
from scene.observation.detection import SupportPlane
from scene.search.support_table import SupportTable
from shapes.geometry.poses import matrices_of, placed_points, transform_points

UNKNOWN_CARRIER = 0.1
"""Odds of resting on something that is seen but not known against resting on what is. Chosen on five
synthetic tables (docs/model.md, development films) without the shapes of some carriers: 0.5 lost an object
that was only found for what it carries, 0.03 one on something unknown."""

ROWS = 32
"""Poses of which the gaps to all others are computed together, so that they stay in a core's cache: speed."""

GAPS = 2**16
"""Densities of one call of a kernel."""


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
        changed: NDArray[np.bool_],
        before: SupportTable,
    ) -> SupportTable:
        """How poses (N, K, 7) camera_from_box and, last, the absent object rest; without a table as before.

        What is beside the table may stand on something else.

        Args:
            view: of the table.
            table: in the camera's frame.
            objects: N.
            poses: of each of them.
            changed: (N, K) which of them `before` does not hold.
            before: how the others rest.
        """
        if table is None:
            return before
        table_from_box = np.linalg.inv(table.camera_from_table) @ matrices_of(poses)
        each = zip(objects, table_from_box, strict=True)
        undersides_m = np.stack([undersides(placed_points(mine, one.points_m)) for one, mine in each])
        lowest_m = undersides_m[:, :, 0]
        heights_m = _heights(table, lowest_m)
        hanging = heights_m > 0
        seen_m = np.full(changed.shape, np.inf, np.float32)
        seen_m[hanging & changed] = gaps_to_seen(view, table, undersides_m[hanging & changed])
        log_alone, log_on = np.array(before.log_alone), np.array(before.log_on)
        anew = np.asarray(_log_alone(self, heights_m.astype(np.float32), seen_m))
        log_alone[:, :-1][changed], log_on[:, :-1][changed] = anew[changed], -np.inf
        for children, parents in ((changed, np.ones_like(changed)), (~changed, changed)):
            rows, columns = np.nonzero(hanging & children), np.nonzero(parents)
            log_on[(*(one[:, None] for one in rows), *columns)] = self._log_on(
                _gaps(objects, table_from_box, lowest_m, rows, columns)
            )
        return SupportTable(jax.device_put(log_alone), jax.device_put(log_on))

    def _log_on(self, gaps_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Log densities of gaps of any shape, over that of none; -inf of infinite ones."""
        log_density = np.full(gaps_m.shape, -np.inf, np.float32)
        finite = np.isfinite(gaps_m)
        if finite.any():
            log_density[finite] = score_on_all_cores(partial(_log_gap, self), gaps_m[finite], GAPS)
        return log_density


def _log_over_none(gravity: Gravity, gap_m: jax.Array) -> jax.Array:
    """Log density of gaps over that of none."""
    return jnp.log(gap_density(gravity, gap_m) / gap_density(gravity, jnp.zeros_like(gap_m)))


_log_gap = jax.jit(_log_over_none, compiler_options=FAST_COMPILE)


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _log_alone(gravity: Gravity, heights_m: jax.Array, seen_m: jax.Array) -> jax.Array:
    """Log densities (N, K) of poses by what is below them, over that of no gap, beside other objects'."""
    floating = gravity.floating_weight / FLOATING_HEIGHT_M / gap_density(gravity, jnp.zeros_like(heights_m))
    log_unknown = jnp.log(UNKNOWN_CARRIER) + _log_over_none(gravity, seen_m)
    return jnp.maximum(jnp.maximum(_log_over_none(gravity, heights_m), jnp.log(floating)), log_unknown)


def _heights(table: SupportPlane, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights (...) of points (..., 3) of the table's frame over it; 0 beside and below it."""
    beside = (np.abs(points_m[..., :2]) > table.half_size_m).any(axis=-1)
    in_camera = transform_points(table.camera_from_table, points_m)
    return np.where(beside, 0.0, np.maximum(table.heights(in_camera), 0.0))


def _gaps(
    objects: Sequence[SceneObject],
    table_from_box: NDArray[np.float64],
    lowest_m: NDArray[np.float64],
    children: tuple[NDArray[np.intp], ...],
    parents: tuple[NDArray[np.intp], ...],
) -> NDArray[np.float32]:
    """Gaps (n, m) of poses to the tops of others' boxes, +inf beside them and to their own object's.

    The top is looked for below an object's middle and below its lowest point.

    Args:
        objects: N.
        table_from_box: (N, K, 4, 4) their poses.
        lowest_m: (N, K, 3) the lowest points.
        children: (n,) objects and (n,) numbers of the poses that rest on others.
        parents: (m,) objects and (m,) numbers of these.
    """
    half_m = np.stack([one.half_extents_m for one in objects])[parents[0]]
    boxes, lowest_m = table_from_box[parents], lowest_m[children]
    feet_m = np.stack([table_from_box[children][:, :2, 3], lowest_m[:, :2]])

    def to_tops(first: int) -> NDArray[np.float32]:
        mine = slice(first, first + ROWS)
        gaps_m = np.abs(lowest_m[mine, 2, None] - _tops_below(boxes, half_m, feet_m[:, mine])).min(axis=0)
        return np.where(children[0][mine, None] == parents[0], np.inf, gaps_m).astype(np.float32)

    shares = map_parallel(to_tops, range(0, len(lowest_m), ROWS))
    return np.concatenate(shares) if shares else np.zeros((0, len(boxes)), np.float32)


def _tops_below(
    boxes: NDArray[np.float64], half_extents_m: NDArray[np.float64], feet_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Heights (..., m) at which vertical lines through feet (..., 2) leave boxes (m, 4, 4) upwards, or inf.

    A line meets the middle plane between two faces at a height that is linear in its foot.
    """
    up = boxes[:, 2, :3]
    slope = np.where(np.abs(up) < 1e-9, 1e-9, up)
    per_m = -boxes[:, :2, :3] / slope[:, None]
    middle_m = (up * boxes[:, 2, 3, None] / slope) - (per_m * boxes[:, :2, 3, None]).sum(axis=1)
    beyond_m = half_extents_m / np.abs(slope)
    enters, leaves = np.float64(-np.inf), np.float64(np.inf)
    for axis in range(3):
        between_m = feet_m @ per_m[:, :, axis].T + middle_m[:, axis]
        enters = np.maximum(enters, between_m - beyond_m[:, axis])
        leaves = np.minimum(leaves, between_m + beyond_m[:, axis])
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
    heights_m = table.in_table_frame(view.points_m)[..., 2]
    down_m = STEP_M * (np.arange(STEPS) + 0.5)
    below_m = undersides_m[:, :, None] - down_m[:, None] * np.array([0.0, 0.0, 1.0])
    in_camera = transform_points(table.camera_from_table, below_m)
    rows, columns, inside = pixels_at(in_camera, view.camera, depth_m.shape)
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
        points = placed_points(camera_from_box[number], one.points_m.astype(np.float64))
        below_m = np.where(table.covers(table.in_table_frame(points)), -table.heights(points), 0.0)
        deepest_m[number] = below_m.max(axis=1).clip(0)
    return -0.5 * (deepest_m / sigma_m) ** 2
