"""Template matching by projection: surface points against observed depth, then ICP of the best.

Every hypothesis puts one visible point of the object on one observed point (so that depth is given), or
the box's centre on the centre of a cluster. A few surface points tell most hypotheses apart, all points
the rest; the best ones that differ are refined.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import jaxlie

from scene.observation.depth_view import PooledView
from scene.search.icp import Vector, ViewTable, align, dot, faces_camera, look_up, rotated
from shapes.stored_kernels import jit_stored

TOLERANCE_M = 0.012
"""Gap in depth at which the agreement of a point has fallen to about half; at twice that there is none."""

COARSE = 0.15
"""Tolerance over an object's radius while orientations are tens of degrees off."""

BEHIND = 2.5
"""Tolerances by which a surface may be seen behind the object before it speaks against it."""

TAKEN = 0.5
"""Weight against the object of a point that agrees with a surface explained by something else."""

HIDDEN = 0.4
"""What a point counts in the mean that something nearer hides: little, but not nothing, else a pose of which
one point is seen would be as good as one that is seen whole."""

FEW_POINTS = 16
"""Of the surface, by which most hypotheses are told apart. Search effort."""

TURNED_TOGETHER = 8
"""Orientations whose positions get their first sight in one kernel: starting it costs as much as one's."""

FACING = -0.2
"""Cosine between normal and line of sight below which a surface point is taken for seen at first sight."""

PER_ANCHOR, PER_CENTRE = 14, 32
"""Hypotheses that every place may put forward: a large face elsewhere must not crowd the right ones out."""

SAME_PLACE_M = 0.015
"""Poses nearer than this, and turned by less than the angle below, are one."""

SAME_ANGLE_COSINE = 0.94
"""Cosine of 20 degrees."""

NEIGHBOURHOOD_M, CROWDING = 0.05, 0.04
"""Each chosen pose lowers the scores round it, for the pool to spread."""

CANDIDATES = 256
"""Poses of an object and round that are refined. Search effort."""

ICP_MIDDLE_M, ICP_LAST_M = 0.01, 0.003
"""Scales of residuals at the end of the coarse ICP and of the fine one."""

COARSE_POINTS = 128
"""Of the surface in the coarse ICP. Search effort."""

SLIDING_ROUNDS = 2
"""Of slides, ICP after each."""

SLIDES_M = (-0.06, -0.04, -0.025, -0.015, -0.008, 0.008, 0.015, 0.025, 0.04, 0.06)
"""Along each axis of the object's box."""

COARSE_ITERATIONS, SETTLING_ITERATIONS, FINE_ITERATIONS = 7, 3, 10
"""Of ICP: before slides, after each, and at last with all points. Search effort."""

_CONTACTS = ((0.5, 0.5), (0.25, 0.3), (0.75, 0.7), (0.3, 0.75), (0.7, 0.25))
"""Which visible points are put on observed ones: places in the outline's bounding rectangle."""


@jit_stored()
def match_templates(
    view: PooledView,
    points_m: jax.Array,
    normals: jax.Array,
    rotations: jax.Array,
    anchors_m: jax.Array,
    centres_m: jax.Array,
    beside: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Refined poses (CANDIDATES, 7) camera_from_box, and what they were before.

    The best of the templates that differ come first, best first, and then `beside`.

    Args:
        view: the observation.
        points_m: (P, 3) surface points in the box frame, any prefix well spread.
        normals: (P, 3).
        rotations: (O, 3, 3) camera_from_box.
        anchors_m: (A, 3) observed points.
        centres_m: (C, 3) where the box's centre may be.
        beside: (B, 7) poses from elsewhere, which are refined in place of as many of the CANDIDATES.
    """
    table = ViewTable.of(view)
    coarse_m = jnp.maximum(TOLERANCE_M, COARSE * jnp.linalg.norm(jnp.max(jnp.abs(points_m), axis=0)))
    poses, own = beside, CANDIDATES - len(beside)
    if own:
        matched = _matched(table, points_m, normals, coarse_m, rotations, anchors_m, centres_m, own)
        poses = jnp.concatenate([matched, beside])
    everything = jnp.ones((CANDIDATES, COARSE_POINTS), bool)
    few = points_m[:COARSE_POINTS], normals[:COARSE_POINTS]
    candidates = poses
    poses = align(table, *few, everything, poses, coarse_m, ICP_MIDDLE_M, COARSE_ITERATIONS)

    def settled(_: int, poses: jax.Array) -> jax.Array:
        poses = jax.vmap(partial(_slid, table, *few))(poses)
        return align(table, *few, everything, poses, ICP_MIDDLE_M, ICP_MIDDLE_M, SETTLING_ITERATIONS)

    poses = jax.lax.fori_loop(0, SLIDING_ROUNDS, settled, poses)
    everything = jnp.ones((CANDIDATES, len(points_m)), bool)
    refined = align(table, points_m, normals, everything, poses, ICP_MIDDLE_M, ICP_LAST_M, FINE_ITERATIONS)
    return refined, candidates


def _matched(
    view: ViewTable,
    points_m: jax.Array,
    normals: jax.Array,
    tolerance_m: jax.Array,
    rotations: jax.Array,
    anchors_m: jax.Array,
    centres_m: jax.Array,
    count: int,
) -> jax.Array:
    """The best `count` poses (n, 7) that differ among all rotations in all places."""
    at_first_sight = partial(_first_sight, view, points_m, normals, tolerance_m, anchors_m, centres_m)
    offsets, coarse = jax.lax.map(at_first_sight, rotations, batch_size=TURNED_TOGETHER)
    places = _best_everywhere(coarse, len(anchors_m))
    turned, placed = rotations[places // offsets.shape[1]], offsets.reshape(-1, 3)[places]
    scores = jax.vmap(partial(_score, view, points_m, normals, tolerance_m))(turned, placed)
    chosen = best_distinct(turned, placed, scores, count)
    return jax.vmap(_pose)(turned[chosen], placed[chosen])


def _first_sight(
    view: ViewTable,
    points_m: jax.Array,
    normals: jax.Array,
    tolerance_m: jax.Array,
    anchors_m: jax.Array,
    centres_m: jax.Array,
    rotation: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Positions (A * 5 + C, 3) of the box's centre for one orientation, and their scores by a few points."""
    forward = jnp.mean(anchors_m, axis=0)
    forward = forward / jnp.linalg.norm(forward)
    turned, outward = points_m @ rotation.T, normals @ rotation.T
    facing = outward @ forward < FACING
    contacts = turned[_contacts(turned, facing, forward)]
    touching = (anchors_m[:, None] - contacts[None]).reshape(-1, 3)
    offsets = jnp.concatenate([touching, centres_m])
    x, y, z = offsets.T
    order = jnp.arange(len(facing), dtype=jnp.float32) + jnp.where(facing, 0.0, len(facing))
    _, first = jax.lax.top_k(-order, FEW_POINTS)
    turned, outward = turned[first], outward[first]

    def add(index: int, sums: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        point = [x + turned[index, 0], y + turned[index, 1], z + turned[index, 2]]
        evidence, weight = _evidence(view, point, outward[index], tolerance_m)
        return sums[0] + evidence, sums[1] + weight

    nothing = jnp.zeros(len(offsets))
    evidence, weight = jax.lax.fori_loop(0, FEW_POINTS, add, (nothing, nothing))
    return offsets, evidence / weight


def _slid(view: ViewTable, points_m: jax.Array, normals: jax.Array, pose: jax.Array) -> jax.Array:
    """The best of a pose (7,) and others along the axes of its box, where flat faces let ICP drift."""
    rotation = jaxlie.SO3(pose[:4]).as_matrix()
    shifts = jnp.asarray(SLIDES_M)[:, None, None] * jnp.eye(3)[None]
    placed = pose[None, 4:] + jnp.concatenate([jnp.zeros((1, 3)), shifts.reshape(-1, 3)]) @ rotation.T
    scores = jax.vmap(partial(_score, view, points_m, normals, TOLERANCE_M, rotation))(placed)
    return pose.at[4:].set(placed[jnp.argmax(scores)])


def _contacts(turned_m: jax.Array, facing: jax.Array, forward: jax.Array) -> jax.Array:
    """The points (5,) among turned ones (P, 3) that are put on observed ones."""
    right = jnp.array([1.0, 0.0, 0.0]) - forward[0] * forward
    right = right / jnp.linalg.norm(right)
    flat = jnp.stack([turned_m @ right, turned_m @ jnp.cross(forward, right)], axis=1)
    low = jnp.min(jnp.where(facing[:, None], flat, jnp.inf), axis=0)
    high = jnp.max(jnp.where(facing[:, None], flat, -jnp.inf), axis=0)
    targets = low[None] + (high - low)[None] * jnp.asarray(_CONTACTS)
    distance = jnp.sum((flat[None] - targets[:, None]) ** 2, axis=-1)
    return jnp.argmin(jnp.where(facing[None], distance, jnp.inf), axis=1)


def _score(
    view: ViewTable,
    points_m: jax.Array,
    normals: jax.Array,
    tolerance_m: jax.Array | float,
    rotation: jax.Array,
    offset_m: jax.Array,
) -> jax.Array:
    """Mean evidence of the points that face the camera."""
    outward = rotated(rotation, normals)
    placed = [component + offset_m[axis] for axis, component in enumerate(rotated(rotation, points_m))]
    should = faces_camera(placed, outward)
    evidence, weight = _evidence(view, placed, outward, tolerance_m)
    return jnp.sum(jnp.where(should, evidence, 0.0)) / jnp.maximum(jnp.sum(jnp.where(should, weight, 0.0)), 1)


def _evidence(
    view: ViewTable, point: Vector, outward: Vector, tolerance_m: jax.Array | float
) -> tuple[jax.Array, jax.Array]:
    """For each point 1 if it is seen where it should be, down to -1 if what is behind it is seen; its weight.

    Where the table or another object explains the pixel already, to agree with it speaks against the
    object: else every flat one would be found inside the table's top.
    """
    observed = look_up(view, point)
    gap = (observed.depth_m - point[2]) / tolerance_m
    normal = observed.normal
    known = dot(normal, normal) > 0
    cosine = jnp.clip(dot(normal, outward), 0, 1)
    near = jnp.maximum(1 - (0.5 * gap) ** 2, 0) ** 2
    alike = jnp.where(known, cosine**2, 0.5) * near
    evidence = jnp.where(observed.unexplained, alike, -TAKEN * alike) - (gap > BEHIND)
    weight = jnp.where(observed.measured & (gap < -BEHIND), HIDDEN, 1.0)
    return jnp.where(observed.measured, evidence, 0.0), weight


def _best_everywhere(coarse: jax.Array, anchors: int) -> jax.Array:
    """Flat places of the best scores (O, A * 5 + C) of every anchor and every centre."""
    number = jnp.arange(coarse.size).reshape(coarse.shape)
    split = anchors * len(_CONTACTS)

    def by_place(table: jax.Array) -> jax.Array:
        grouped = table[:, :split].reshape(len(table), anchors, -1)
        return jnp.moveaxis(grouped, 1, 0).reshape(anchors, -1)

    _, near_anchors = jax.lax.top_k(by_place(coarse), PER_ANCHOR)
    _, near_centres = jax.lax.top_k(coarse[:, split:].T, PER_CENTRE)
    chosen = (
        jnp.take_along_axis(by_place(number), near_anchors, axis=1),
        jnp.take_along_axis(number[:, split:].T, near_centres, axis=1),
    )
    return jnp.concatenate([places.ravel() for places in chosen])


@partial(jax.jit, static_argnames="count")
def best_distinct(rotations: jax.Array, offsets_m: jax.Array, scores: jax.Array, count: int) -> jax.Array:
    """Places (count,) of the best scores, none next to a better one; repeats the best when few differ."""

    def take(index: int, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        left, chosen = state
        best = jnp.argmax(left)
        best = jnp.where(jnp.isfinite(left[best]), best, chosen[0])
        distance2 = jnp.sum((offsets_m - offsets_m[best][None]) ** 2, axis=1)
        cosine = (jnp.sum(rotations * rotations[best][None], axis=(1, 2)) - 1) / 2
        same = (distance2 < SAME_PLACE_M**2) & (cosine > SAME_ANGLE_COSINE)
        crowded = left - CROWDING * jnp.exp(-0.5 * distance2 / NEIGHBOURHOOD_M**2)
        left = jnp.where(same, -jnp.inf, crowded)
        return left, chosen.at[index].set(best)

    start = scores, jnp.full(count, jnp.argmax(scores))
    return jax.lax.fori_loop(0, count, take, start)[1]


def _pose(rotation: jax.Array, offset_m: jax.Array) -> jax.Array:
    return jnp.concatenate([jaxlie.SO3.from_matrix(rotation).wxyz, offset_m])
