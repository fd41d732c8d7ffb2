"""Smoothed trajectories: what the last particles say of every frame."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from recordings.distortion_field import NODE_COLUMNS, NODE_ROWS
from recordings.types import CameraIntrinsics
from shapes.geometry import pose_gaussian
from shapes.geometry.pose_sets import IDENTITY, cluster, mean_and_covariance
from shapes.geometry.poses import matrices_of
from slam.filter.state import FilterState, Ties
from slam.history import FRAMES_AT_ONCE, History
from slam.pose_graph.refinement import PlacedKeyframes, RefinedKeyframes
from slam.result import SlamResult

UNDERSTATED, DEGREES_OF_FREEDOM = 1.5, 13.0
"""By how much the curvature, tempered as the spread of the blocks' scores says, understates the variance that
noise gives poses in all directions, and how surely that is known: blocks differ from image to image and room
to room, and a Gaussian whose scale is only known to a chi-square is a Student-t. The F distribution of
greatest likelihood for the squared distances of all frames of 411 short walks without a distortion field
(`bench slam --only coverage`; docs/model.md, development films)."""


def smoothed(
    history: History, state: FilterState, placed: RefinedKeyframes, intrinsics: CameraIntrinsics
) -> SlamResult:
    """Every frame carried by the keyframe it is anchored to, or became, where the last particles have it.

    A particle's trajectory follows its own ancestors. The marginal of a frame mixes the particles'
    conditional Gaussians, those of its keyframe and of itself, so that it keeps its spread where few
    ancestors survive, and is a Student-t, widened by what was learnt to be `UNDERSTATED`. Where two
    motions compete it reaches to the other one. The particles themselves are not spread, and are those
    of the images as they are. Frames follow the sensor's distortion field, which is unknown. A frame
    whose keyframe nothing ties to the first is lost.

    Args:
        history: of all frames.
        state: after the last one.
        placed: where the keyframes were refined to, and the distortion field.
        intrinsics: of the camera.
    """
    log_weights = np.asarray(state.population.log_weights, np.float64)
    central = _of_the_heaviest_mode(state.keyframe_poses, log_weights)
    lineages = history.lineages()
    mode = int(np.argmax(np.bincount(placed.mode, np.exp(log_weights))))
    draws = np.empty((len(log_weights), len(history), 7), np.float32)
    told: list[dict[str, NDArray[Any]]] = []
    for frames, infos in history.stacked():
        anchors = np.where(infos.is_keyframe, infos.keyframes - 1, infos.anchor)
        draws[:, frames], mean, covariance = _block(infos, anchors, lineages[frames], state, placed, central)
        displaced = infos.doubt.displacements.astype(np.float64)
        told.append(
            {
                "mean": matrices_of(mean),
                "covariance": covariance / (1.0 - 2.0 / DEGREES_OF_FREEDOM)
                + displaced @ displaced.transpose(0, 2, 1),
                "lost": infos.lost | ~placed.held[mode, anchors],
                **{name: getattr(infos, name) for name in ("ess", "log_evidence", "resampled", "explained")},
            }
        )
    nodes = (NODE_ROWS, NODE_COLUMNS)
    return SlamResult(
        times_ns=np.asarray(history.times_ns, np.int64),
        draws=draws,
        log_weights=log_weights - logsumexp(log_weights),
        degrees_of_freedom=np.asarray(DEGREES_OF_FREEDOM),
        disparity_per_m=placed.disparity_per_m[mode].reshape(nodes),
        disparity_sd_per_m=placed.sd_per_m[mode].reshape(nodes),
        camera=np.asarray([float(value) for value in vars(intrinsics).values()]),
        **{name: np.concatenate([one[name] for one in told]) for name in told[0]},
    )


def _block(
    infos: Any,
    anchor_of: NDArray[np.int32],
    lineages: NDArray[np.int32],
    state: FilterState,
    placed: RefinedKeyframes,
    central: jax.Array | None,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64]]:
    """Trajectories (K, n, 7), means (n, 7) and covariances (n, 6, 6) of n frames, their leaves stacked."""
    known = len(anchor_of)
    rows = np.minimum(np.arange(FRAMES_AT_ONCE), known - 1)
    infos, anchor_of, lineages = jax.tree.map(lambda leaf: leaf[rows], (infos, anchor_of, lineages))
    drawn, components, frames = ~infos.is_keyframe[:, None], infos.component, np.arange(len(rows))[:, None]
    components = components[frames, lineages]
    at_anchor = np.asarray(IDENTITY, np.float32)
    draws, means = (
        np.where(drawn[..., None], poses[frames, lineages], at_anchor).swapaxes(0, 1)
        for poses in (infos.relative_poses, infos.relative_means)
    )
    conditional = np.where(drawn[..., None, None], infos.component_covariances[frames, components], 0.0)
    is_best = (drawn & (components == 0)).T[..., None]
    following = np.einsum("tin,gnf->gtif", infos.field_sensitivity, placed.factor.astype(np.float32))
    pulled, of_field = _by_ties(placed.at(infos.ties.keyframes), infos.ties)
    pulls = jnp.where(is_best, pulled[placed.mode], 0.0)
    draws, means = (_pulled(jnp.asarray(poses), pulls) for poses in (draws, means))
    anchors = jnp.asarray(state.keyframe_poses[:, anchor_of])
    centres, spread = _with_placed(
        anchors,
        means,
        jnp.asarray(conditional.swapaxes(0, 1)),
        jnp.asarray(placed.mode),
        placed.at(anchor_of),
        following + of_field,
    )
    mean, covariance = _marginals(centres, means, state.population.log_weights, spread, central)
    return (
        np.asarray(_composed(anchors, draws))[:, :known],
        np.asarray(mean)[:known],
        np.asarray(covariance, np.float64)[:known],
    )


def _of_the_heaviest_mode(
    keyframe_poses: NDArray[np.float32], log_weights: NDArray[np.float64]
) -> jax.Array | None:
    """Weights (K,) of its particles alone, for a mean over several maps lies in none; None where all are."""
    weights = np.exp(log_weights)
    modes = cluster(matrices_of(keyframe_poses), weights)
    if not modes.any():
        return None
    central = np.where(modes == np.argmax(np.bincount(modes, weights)), weights, 0.0)
    return jnp.asarray(central / central.sum(), jnp.float32)


@jax.jit
def _composed(anchors: jax.Array, relative: jax.Array) -> jax.Array:
    """Products (K, T, 7) of poses (K, T, 7)."""
    product = jax.vmap(jax.vmap(lambda anchor, pose: (jaxlie.SE3(anchor) @ jaxlie.SE3(pose)).wxyz_xyz))
    return product(anchors, relative)


@jax.jit
def _by_ties(tied: PlacedKeyframes, ties: Ties) -> tuple[jax.Array, jax.Array]:
    """What other keyframes than the anchor add: displacements (G, T, 6) of frames, camera chart.

    Leaves of the ties are stacked (T, ...), those of their keyframes (G, T, M, ...). Also how frames follow
    the distortion field (G, T, 6, F).
    """

    def of_mode(tied: PlacedKeyframes) -> tuple[jax.Array, jax.Array]:
        def of_frame(frame: tuple[PlacedKeyframes, Ties]) -> tuple[jax.Array, jax.Array]:
            tied, ties = frame
            cameras = jax.vmap(lambda one, relative: (jaxlie.SE3(one) @ jaxlie.SE3(relative)).wxyz_xyz)(
                tied.poses, ties.keyframes_from_camera
            )
            apart = jax.vmap(pose_gaussian.coordinates, (None, 0))(cameras[0], cameras)
            following = jax.vmap(_to_camera)(jnp.asarray(ties.keyframes_from_camera)) @ tied.sensitivity
            shares = jnp.where(tied.held[:, None, None] & tied.held[0], ties.shares, 0.0)
            return (
                jnp.einsum("mij,mj->i", shares, apart),
                jnp.einsum("mij,mjf->if", shares, following - following[:1]),
            )

        return jax.lax.map(of_frame, (tied, ties))

    return jax.vmap(of_mode)(tied)


@jax.jit
def _pulled(relative: jax.Array, displacements: jax.Array) -> jax.Array:
    """Poses (K, T, 7) displaced by (K, T, 6)."""
    return jax.vmap(jax.vmap(pose_gaussian.displace))(relative, displacements)


def _to_camera(relative: jax.Array) -> jax.Array:
    """A displacement of an anchor in its own chart as one (6, 6) of a camera at anchor_from_camera (7,) R, t.

    It is R^T (xi_t + xi_r x t) and R^T xi_r in the camera's.
    """
    pose = jaxlie.SE3(relative)
    inverse = pose.rotation().as_matrix().T
    lever = inverse @ jnp.cross(jnp.eye(3), pose.translation()).T
    return jnp.block([[inverse, lever], [jnp.zeros((3, 3)), inverse]])


@jax.jit
def _with_placed(
    anchors: jax.Array,
    relative: jax.Array,
    conditional: jax.Array,
    mode_of: jax.Array,
    placed: PlacedKeyframes,
    following: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Anchors (K, T, 7) before particles drew them, and their spread added to the conditional (K, T, 6, 6).

    What noise gives is widened by `UNDERSTATED`; what the distortion field gives is not.
    Camera and anchor, which leaves (G, T, ...) place, follow one field, the camera by (G, T, 6, F) itself.
    """

    def of_particle(
        particle: tuple[jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array]:
        mode, anchors, relative = particle
        own = jax.tree.map(lambda leaf: leaf[mode], placed)
        jacobian = jax.vmap(_to_camera)(relative)
        held = own.held[:, None, None]
        spread = jacobian @ own.covariances @ jacobian.mT
        total = following[mode] + jnp.where(held, jacobian @ own.sensitivity, 0.0)
        shared = total @ total.mT
        poses = jnp.where(held[:, 0], own.poses, anchors)
        return poses, jnp.where(held, UNDERSTATED * spread, 0.0) + shared

    known, spread = jax.lax.map(of_particle, (mode_of, anchors, relative))
    return known, UNDERSTATED * conditional + spread


@jax.jit
def _marginals(
    anchors: jax.Array,
    relative_means: jax.Array,
    log_weights: jax.Array,
    conditional: jax.Array,
    central: jax.Array | None,
) -> tuple[jax.Array, jax.Array]:
    """Means (T, 7) and covariances (T, 6, 6) over particles (K, T, 7) with spreads (K, T, 6, 6)."""
    poses = _composed(anchors, relative_means)
    return jax.vmap(mean_and_covariance, (1, None, 1, None))(
        poses, jnp.exp(log_weights), conditional, central
    )
