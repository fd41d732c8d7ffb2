"""The map is refined while it grows, so that the filter goes on in one that drifts little.

Errors of the filter add up along the path, to tens of centimetres where the refined map drifts by
centimetres. Loops would be looked for too far away, and a place that the camera comes back to would be taken
for another one. So the latest keyframes are brought to the optimum of their overlaps every so many of them,
the earlier ones staying where they were left; the last frames move along with the last keyframe.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from slam.filter.state import FilterState, Hypothesis
from slam.keyframes.covisibility import LEAST_HOPS
from slam.pose_graph.coarse_to_fine import optimise_coarse_to_fine
from slam.pose_graph.overlaps import KeyframeImages

REFINED_EVERY = 20
"""Keyframes: search effort."""

FREE_KEYFRAMES = 2 * REFINED_EVERY
"""The latest ones, which are refined: each twice, once with those that followed it."""


def is_due(state: FilterState) -> bool:
    """Whether the keyframe that has just been added is one after which the map is refined.

    It is earlier where keyframes contradict each other: a loop is probably to be closed.
    """
    added = len(state.keyframe_map) - state.refined_keyframes
    return added >= (LEAST_HOPS if state.contradicted else REFINED_EVERY)


def refined_so_far(
    state: FilterState, images: KeyframeImages, on_phase: Callable[[str], None] = lambda _: None
) -> FilterState:
    """The state after a frame that became a keyframe, the latest ones of each hypothesis refined.

    `on_phase` is told of loops that are closed.
    """
    histories = tuple(_refined(one, images, on_phase) for one in state.population.histories)
    heaviest = int(np.argmax(state.population.log_weights))
    before, after = state.population.histories[heaviest].pose, histories[heaviest].pose
    return replace(
        state,
        population=replace(state.population, histories=histories),
        rival=replace(state.rival, pose=_carried(jnp.asarray(before), jnp.asarray(after), state.rival.pose)),
        refined_keyframes=len(state.keyframe_map),
        contradicted=False,
    )


def _refined(hypothesis: Hypothesis, images: KeyframeImages, on_phase: Callable[[str], None]) -> Hypothesis:
    before, images = hypothesis.keyframe_poses, replace(images, known=hypothesis.overlaps)
    fixed = max(1, len(before) - FREE_KEYFRAMES)
    _, found, loops = optimise_coarse_to_fine(images, before, fixed=fixed, on_phase=on_phase)
    if found is None or not np.isfinite(found.poses).all():
        return hypothesis
    known = images.with_known(loops.pairs).known
    assert known is not None
    carried = _carried(*map(jnp.asarray, (before[-1], found.poses[-1], hypothesis.previous_pose)))
    return replace(
        hypothesis,
        keyframe_poses=found.poses,
        pose=found.poses[-1],
        previous_pose=np.asarray(carried),
        overlaps=known,
    )


@jax.jit
def _carried(before: jax.Array, after: jax.Array, pose: jax.Array) -> jax.Array:
    """A pose (7,) that keeps to another one, which was moved."""
    carried = jaxlie.SE3(after) @ jaxlie.SE3(before).inverse() @ jaxlie.SE3(pose)
    return carried.normalize().wxyz_xyz
