"""What the filter tells of a frame: poses beside a keyframe, which later refinement carries along."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from slam import pose_gaussian, smc
from slam.filter_state import FilterState, FrameInfo
from slam.particles import CameraParticles
from slam.proposal import Component, Proposed
from slam.search import Located


def frame_info(
    state: FilterState,
    known_keyframes: int,
    info: smc.StepInfo,
    proposed: Proposed,
    components: Component,
    found: list[Located],
    lost: bool,
) -> FrameInfo:
    """Of a frame after its step.

    Args:
        state: after it.
        known_keyframes: number of keyframes before it.
        info: of the generic step.
        proposed: the draws.
        components: of the proposal.
        found: optima, as by `slam.finding.found_places`.
        lost: whether there was none.
    """
    particles: CameraParticles = state.population.particles
    anchor = int(found[0].indices[0])
    anchors = particles.keyframe_poses[:, anchor]
    means, scales = proposed.conditional_mean, np.asarray(components.scale)
    covariances = scales @ scales.transpose(0, 2, 1)
    if lost:
        means = jnp.tile(state.last_found, (len(anchors), 1))
        spread = spread_around(state.last_found, proposed.pose, state.population.log_weights)
        covariances = np.tile(spread, (len(scales), 1, 1))
    return FrameInfo(
        anchor=anchor,
        relative_poses=np.asarray(_relative(anchors, proposed.pose)),
        relative_means=np.asarray(_relative(anchors, means)),
        component=np.asarray(proposed.component),
        component_covariances=covariances,
        log_weights=np.asarray(state.population.log_weights),
        ancestors=np.asarray(info.ancestors),
        log_evidence=float(info.log_evidence),
        ess=float(info.ess),
        resampled=bool(info.resampled),
        lost=lost,
        explained=found[0].explained,
        covered=found[0].covered,
        keyframes=len(state.keyframe_map),
        keyframe=known_keyframes if len(state.keyframe_map) > known_keyframes else None,
        components=0 if lost else len(found),
    )


@jax.jit
def _relative(anchors: jax.Array, poses: jax.Array) -> jax.Array:
    """anchor_from_camera (K, 7)."""

    def one(anchor: jax.Array, pose: jax.Array) -> jax.Array:
        return (jaxlie.SE3(anchor).inverse() @ jaxlie.SE3(pose)).wxyz_xyz

    return jax.vmap(one)(anchors, poses)


@jax.jit
def spread_around(centre: jax.Array, poses: jax.Array, log_weights: jax.Array) -> jax.Array:
    """Second moment (6, 6) of weighted poses (K, 7) in the chart at `centre` (7,)."""
    tangents = jax.vmap(pose_gaussian.coordinates, (None, 0))(centre, poses)
    return jnp.einsum("k,ki,kj->ij", jnp.exp(log_weights), tangents, tangents)
