"""The filter's history, and the smoothed trajectories that the surviving particles imply."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from recordings.sensor_profile import NODE_COLUMNS, NODE_ROWS
from recordings.types import CameraIntrinsics
from shapes.geometry import pose_gaussian
from shapes.geometry.pose_sets import IDENTITY, cluster, mean_and_covariance
from shapes.geometry.poses import matrices_of
from slam.filter.state import CameraParticles, FilterState, FrameInfo, Ties
from slam.pose_graph.refinement import RefinedKeyframes
from slam.result import SlamResult

UNDERSTATED, DEGREES_OF_FREEDOM = 1.5, 13.0
"""By how much the curvature, tempered as the spread of the blocks' scores says, understates the variance that
noise gives poses in all directions, and how surely that is known: blocks differ from image to image and room
to room, and a Gaussian whose scale is only known to a chi-square is a Student-t. The F distribution of
greatest likelihood for the squared distances of all frames of 411 short walks without a distortion field
(`bench slam --only coverage`; docs/model.md, development films)."""


FRAMES_AT_ONCE = 256
"""Whose particles' spreads are in memory together, 4 MB a hundred: kernels are compiled for so many."""


@dataclass(kw_only=True)
class History:
    """Grows by a few kilobytes a frame; images are not kept."""

    times_ns: list[int] = field(default_factory=list)
    frames: list[FrameInfo] = field(default_factory=list)

    def append(self, time_ns: int, info: FrameInfo) -> None:
        """One frame more."""
        self.times_ns.append(time_ns)
        self.frames.append(info)

    def result(
        self, state: FilterState, placed: RefinedKeyframes, intrinsics: CameraIntrinsics
    ) -> SlamResult:
        """Every frame carried by the keyframe it is anchored to, or became, where the last particles have it.

        A particle's trajectory follows its own ancestors. The marginal of a frame mixes the particles'
        conditional Gaussians, those of its keyframe and of itself, so that it keeps its spread where few
        ancestors survive, and is a Student-t, widened by what was learnt to be `UNDERSTATED`. Where two
        motions compete it reaches to the other one. The particles themselves are not spread, and are those
        of the images as they are. Frames follow the sensor's distortion field, which is unknown. A frame
        whose keyframe nothing ties to the first is lost.

        Args:
            state: after the last frame.
            placed: where the keyframes were refined to, and the distortion field.
            intrinsics: of the camera.
        """
        particles: CameraParticles = state.population.particles
        log_weights = np.asarray(state.population.log_weights, np.float64)
        central = _of_the_heaviest_mode(particles.keyframe_poses[:, : len(state.keyframe_map)], log_weights)
        lineages = self._lineages()
        parts = [
            self._smoothed(slice(first, first + FRAMES_AT_ONCE), lineages, state, placed, central)
            for first in range(0, len(self.frames), FRAMES_AT_ONCE)
        ]
        trajectories, mean, covariance = (
            np.concatenate(leaves, axis)
            for leaves, axis in zip(zip(*parts, strict=True), (1, 0, 0), strict=True)
        )
        anchor_of = self._anchors(slice(None))
        mode = int(np.argmax(np.bincount(np.asarray(placed.mode), np.exp(log_weights))))
        nodes = (NODE_ROWS, NODE_COLUMNS)
        untied = ~np.asarray(placed.held)[mode, anchor_of]
        displaced = np.asarray([info.doubt.displacements for info in self.frames], np.float64)
        return SlamResult(
            times_ns=np.asarray(self.times_ns, np.int64),
            trajectories=matrices_of(trajectories),
            log_weights=log_weights - logsumexp(log_weights),
            mean=matrices_of(mean),
            covariance=np.asarray(covariance, np.float64) / (1.0 - 2.0 / DEGREES_OF_FREEDOM)
            + displaced @ displaced.transpose(0, 2, 1),
            degrees_of_freedom=np.asarray(DEGREES_OF_FREEDOM),
            ess=np.asarray([info.ess for info in self.frames]),
            log_evidence=np.asarray([info.log_evidence for info in self.frames]),
            resampled=np.asarray([info.resampled for info in self.frames], bool),
            lost=np.asarray([info.lost for info in self.frames], bool) | untied,
            explained=np.asarray([info.explained for info in self.frames]),
            disparity_per_m=np.asarray(placed.disparity_per_m[mode], np.float64).reshape(nodes),
            disparity_sd_per_m=np.asarray(placed.sd_per_m[mode], np.float64).reshape(nodes),
            camera=np.asarray([float(value) for value in vars(intrinsics).values()]),
        )

    def _lineages(self) -> NDArray[np.int32]:
        """Which particle (T, K) of each frame the last ones descend from."""
        lineages = np.empty((len(self.frames), len(self.frames[-1].ancestors)), np.int32)
        lineage = np.arange(lineages.shape[1])
        for index in range(len(self.frames) - 1, -1, -1):
            lineages[index] = lineage
            lineage = self.frames[index].ancestors[lineage]
        return lineages

    def _anchors(self, frames: slice) -> NDArray[np.int32]:
        """The keyframe (t,) that carries each of some frames, or that it became."""
        anchors = [info.anchor if info.keyframe is None else info.keyframe for info in self.frames[frames]]
        return np.asarray(anchors, np.int32)

    def _smoothed(
        self,
        frames: slice,
        lineages: NDArray[np.int32],
        state: FilterState,
        placed: RefinedKeyframes,
        central: jax.Array | None,
    ) -> tuple[NDArray[np.float32], ...]:
        """Trajectories (K, t, 7), means (t, 7) and covariances (t, 6, 6) of some frames."""
        infos = self.frames[frames]
        infos, known_infos = infos + infos[-1:] * (FRAMES_AT_ONCE - len(infos)), len(infos)
        lineages = lineages[frames][np.minimum(np.arange(FRAMES_AT_ONCE), known_infos - 1)]
        draws = np.tile(np.asarray(IDENTITY, np.float32), (*lineages.T.shape, 1))
        means, is_best = draws.copy(), np.zeros((*lineages.T.shape, 1), bool)
        conditional = np.zeros((*lineages.T.shape, 6, 6), np.float32)
        for index, (info, lineage) in enumerate(zip(infos, lineages, strict=True)):
            if info.keyframe is None:
                draws[:, index], means[:, index] = info.relative_poses[lineage], info.relative_means[lineage]
                conditional[:, index] = info.component_covariances[info.component[lineage]]
                is_best[:, index, 0] = info.component[lineage] == 0
        anchor_of = self._anchors(frames)
        anchor_of = anchor_of[np.minimum(np.arange(FRAMES_AT_ONCE), known_infos - 1)]
        anchors = state.population.particles.keyframe_poses[:, anchor_of]
        of_nodes = np.stack([info.field_sensitivity for info in infos])
        following = np.einsum("tin,gnf->gtif", of_nodes, np.asarray(placed.factor))
        ties: Ties = jax.tree.map(lambda *leaves: np.stack(leaves), *(info.ties for info in infos))
        pulled, of_field = _by_ties(placed, ties)
        pulls = jnp.where(is_best, pulled[placed.mode], 0.0)
        draws, means = (_pulled(jnp.asarray(poses), pulls) for poses in (draws, means))
        known, spread = _with_placed(
            anchors, means, jnp.asarray(conditional), placed, jnp.asarray(anchor_of), following + of_field
        )
        mean, covariance = _marginals(known, means, state.population.log_weights, spread, central)
        trajectories = np.asarray(_composed(anchors, draws))
        return (
            trajectories[:, :known_infos],
            np.asarray(mean)[:known_infos],
            np.asarray(covariance)[:known_infos],
        )


def _of_the_heaviest_mode(keyframe_poses: jax.Array, log_weights: NDArray[np.float64]) -> jax.Array | None:
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
def _by_ties(placed: RefinedKeyframes, ties: Ties) -> tuple[jax.Array, jax.Array]:
    """What other keyframes than the anchor add: displacements (G, T, 6) of frames, camera chart.

    Leaves of the ties are stacked (T, ...). Also how they follow the distortion field (G, T, 6, F).
    """

    def of_mode(poses: jax.Array, held: jax.Array, sensitivity: jax.Array) -> tuple[jax.Array, jax.Array]:
        def of_frame(ties: Ties) -> tuple[jax.Array, jax.Array]:
            keyframes = poses[ties.keyframes], ties.keyframes_from_camera
            cameras = jax.vmap(lambda one, relative: (jaxlie.SE3(one) @ jaxlie.SE3(relative)).wxyz_xyz)(
                *keyframes
            )
            apart = jax.vmap(pose_gaussian.coordinates, (None, 0))(cameras[0], cameras)
            following = jax.vmap(_to_camera)(jnp.asarray(keyframes[1])) @ sensitivity[ties.keyframes]
            shares = jnp.where(
                held[ties.keyframes][:, None, None] & held[ties.keyframes[0]], ties.shares, 0.0
            )
            return (
                jnp.einsum("mij,mj->i", shares, apart),
                jnp.einsum("mij,mjf->if", shares, following - following[:1]),
            )

        return jax.lax.map(of_frame, ties)

    return jax.vmap(of_mode)(placed.poses, placed.held, placed.sensitivity)


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
    placed: RefinedKeyframes,
    anchor_of: jax.Array,
    following: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Anchors (K, T, 7) before particles drew them, and their spread added to the conditional (K, T, 6, 6).

    What noise gives is widened by `UNDERSTATED`; what the distortion field gives is not.
    Camera and anchor follow one distortion field, the camera by (G, T, 6, F) itself.
    """

    def of_particle(
        particle: tuple[jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array]:
        mode, anchors, relative = particle
        jacobian = jax.vmap(_to_camera)(relative)
        held = placed.held[mode, anchor_of][:, None, None]
        spread = jacobian @ placed.covariances[mode, anchor_of] @ jacobian.mT
        total = following[mode] + jnp.where(held, jacobian @ placed.sensitivity[mode, anchor_of], 0.0)
        shared = total @ total.mT
        poses = jnp.where(held[:, 0], placed.poses[mode, anchor_of], anchors)
        return poses, jnp.where(held, UNDERSTATED * spread, 0.0) + shared

    known, spread = jax.lax.map(of_particle, (placed.mode, anchors, relative))
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
