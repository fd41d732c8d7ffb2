"""What hangs in the air is improbable, as the graph's prior has it: where things rest, by their lowest point.

A gap between an object's lowest point and what is below it has the density of gaps in contact; an object
that rests on nothing is anywhere above the table, with the odds of floating. What the image shows below it
may carry it though it be none of the objects, or not be found: else an object on such a thing would be
sought elsewhere. The odds are small enough that what stands on an object still speaks for it.
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

from scene.ahead import SELDOM
from scene.detection import SupportPlane
from scene.observation import DepthView
from scene.prior import FLOATING_HEIGHT_M, gap_density
from scene.rests import Rests
from scene.scene_object import SceneObject
from scene.seen_below import gaps_to_seen, undersides
from shapes.poses import matrices_of

UNKNOWN_CARRIER = 0.1
"""Odds of resting on something that is seen but not known against resting on what is. Chosen on synthetic
tables (seeds 92000, 92003, 95018, 95030, 95037) without the shapes of some carriers: 0.5 lost an object that
was only found for what it carries, 0.03 one on something unknown."""


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
        view: DepthView,
        table: SupportPlane | None,
        objects: Sequence[SceneObject],
        poses: NDArray[np.floating],
        exponent: float,
    ) -> Rests:
        """How poses (N, K, 7) camera_from_box and, last, the absent object rest; without a table all do.

        What is beside the table may stand on something else.

        Args:
            view: of the table.
            table: in the camera's frame.
            objects: N.
            poses: of each of them.
            exponent: of the prior.
        """
        count, places = poses.shape[0], poses.shape[1] + 1
        if table is None:
            return Rests.sure(count, places)
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
        return _rests(self, heights_m, seen_m, gaps_m, exponent)


@partial(jax.jit, compiler_options=SELDOM)
def _rests(
    gravity: Gravity, heights_m: jax.Array, seen_m: jax.Array, gaps_m: jax.Array, exponent: jax.Array
) -> Rests:
    """Logs of the densities of gaps, over that of none."""

    def log_gap(gap_m: jax.Array) -> jax.Array:
        return jnp.log(gap_density(gravity, gap_m) / gap_density(gravity, jnp.zeros_like(gap_m)))

    floating = gravity.floating_weight / FLOATING_HEIGHT_M / gap_density(gravity, jnp.zeros_like(heights_m))
    log_unknown = jnp.log(UNKNOWN_CARRIER) + log_gap(seen_m)
    log_alone = jnp.maximum(jnp.maximum(log_gap(heights_m), jnp.log(floating)), log_unknown)
    return Rests(exponent * log_alone, exponent * log_gap(gaps_m))


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
