"""Smoothed trajectories: what the maps that are left say of every frame."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from recordings.distortion_field import NODE_COLUMNS, NODE_ROWS
from recordings.types import CameraIntrinsics
from shapes.geometry import pose_gaussian
from shapes.geometry.pose_sets import IDENTITY
from shapes.geometry.poses import matrices_of
from slam.filter.state import FoundPlaces, Ties
from slam.history import FRAMES_AT_ONCE, History
from slam.pose_graph.refinement import MapMixture, PlacedKeyframes, RefinedKeyframes
from slam.result import SlamResult

DEGREES_OF_FREEDOM = 13.0
"""How surely the variance that noise gives poses is known: blocks of pixels differ from image to image and
room to room, and a Gaussian whose scale is only known to a chi-square is a Student-t. Of greatest likelihood
for the squared distances of all frames of 411 short walks without a distortion field (`bench slam --only
coverage`; docs/model.md, development films)."""


def smoothed(
    key: jax.Array,
    history: History,
    maps: MapMixture,
    placed: RefinedKeyframes,
    intrinsics: CameraIntrinsics,
) -> SlamResult:
    """Every frame carried by the keyframe it is anchored to, or became, where each map has it.

    The marginal of a frame mixes the maps' Gaussians, that of its keyframe and its own in each, and is a
    Student-t. Where two motions compete it reaches to the other one, and where the true map may not have been
    found to where a walk of the motion prior's steps leads, one for each keyframe from the first. The draws
    are those of the images as they are, and of a map that was found. Frames follow the sensor's distortion
    field, which is unknown. A frame whose keyframe nothing ties to the first is lost.

    Args:
        key: consumed.
        history: of all frames.
        maps: that are left after the last one.
        placed: where their keyframes were refined to, draws of them, and the distortion field.
        intrinsics: of the camera.
    """
    count, lineages = len(placed.mode), history.lineages(maps.hypotheses)
    draws = np.empty((count, len(history), 7), np.float32)
    best = int(np.argmax(maps.probabilities))
    told: list[dict[str, NDArray[Any]]] = []
    for frames, infos in history.stacked():
        block = _block(key, frames.start, infos, lineages[frames], maps, placed)
        draws[:, frames], mean, covariance, anchors = block
        displaced = infos.doubt.displacements.astype(np.float64)
        covariance = covariance / (1.0 - 2.0 / DEGREES_OF_FREEDOM)
        covariance += displaced @ displaced.transpose(0, 2, 1)
        elsewhere = anchors[best][:, None, None] * maps.unseen_step
        told.append(
            {
                "mean": matrices_of(mean),
                "covariance": (1.0 - maps.undiscovered) * covariance + maps.undiscovered * elsewhere,
                "lost": infos.lost | ~placed.held[best, anchors[best]],
                "hypotheses": infos.hypotheses,
                **{name: getattr(infos, name) for name in ("log_evidence", "resampled", "explained")},
            }
        )
    nodes = (NODE_ROWS, NODE_COLUMNS)
    return SlamResult(
        times_ns=np.asarray(history.times_ns, np.int64),
        draws=draws,
        log_weights=np.full(count, -np.log(count)),
        degrees_of_freedom=np.asarray(DEGREES_OF_FREEDOM),
        undiscovered=np.asarray(maps.undiscovered),
        disparity_per_m=placed.disparity_per_m[best].reshape(nodes),
        disparity_sd_per_m=placed.sd_per_m[best].reshape(nodes),
        camera=np.asarray([float(value) for value in vars(intrinsics).values()]),
        **{name: np.concatenate([one[name] for one in told]) for name in told[0]},
    )


def _block(
    key: jax.Array,
    first: int,
    infos: Any,
    lineages: NDArray[np.int32],
    maps: MapMixture,
    placed: RefinedKeyframes,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64], NDArray[np.int_]]:
    """Draws (K, n, 7), means (n, 7), covariances (n, 6, 6) and anchors (G, n) of n frames from the first."""
    known = len(lineages)
    rows = np.minimum(np.arange(FRAMES_AT_ONCE), known - 1)
    infos, lineages = jax.tree.map(lambda leaf: leaf[rows], (infos, lineages))
    own: FoundPlaces = jax.tree.map(lambda leaf: leaf[np.arange(len(rows)), lineages.T], infos.places)
    anchors = np.where(infos.is_keyframe, infos.keyframes - 1, own.anchors)
    at_anchor = np.asarray(IDENTITY, np.float32)
    relative = np.where(infos.is_keyframe[:, None], at_anchor, own.relative_poses)
    covariances = np.where(infos.is_keyframe[:, None, None], 0.0, own.covariances)
    of_ties = PlacedKeyframes.stacked(placed, own.ties.keyframes)
    pulled, of_field = _by_ties(of_ties, own.ties)
    following = np.einsum("gtin,gnf->gtif", own.field_sensitivity, placed.factor.astype(np.float32))
    relative = _pulled(jnp.asarray(relative), pulled)
    at_anchors = PlacedKeyframes.stacked(placed, anchors)
    spread = _spread(at_anchors, relative, jnp.asarray(covariances), following + of_field)
    probabilities = jnp.asarray(maps.probabilities, jnp.float32)
    mean, covariance = _marginals(_composed(at_anchors.poses, relative), spread, probabilities)
    mode = placed.mode
    drawn_anchors = placed.drawn[np.arange(len(mode))[:, None], anchors[mode]]
    roots = _roots(jnp.asarray(covariances))[mode]
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, first + np.arange(len(rows)))
    draws = _drawn(keys, jnp.asarray(drawn_anchors), relative[mode], roots)
    return (
        np.asarray(draws)[:, :known],
        np.asarray(mean)[:known],
        np.asarray(covariance, np.float64)[:known],
        anchors[:, :known],
    )


def _product(anchor: jax.Array, relative: jax.Array) -> jax.Array:
    """The pose (7,) of what stands beside an anchor."""
    return (jaxlie.SE3(anchor) @ jaxlie.SE3(relative)).wxyz_xyz


_composed = jax.jit(jax.vmap(jax.vmap(_product)))
_pulled = jax.jit(jax.vmap(jax.vmap(pose_gaussian.displace)))


@jax.jit
def _roots(covariances: jax.Array) -> jax.Array:
    """Square roots A of matrices (..., 6, 6) A A^T, which may be zero."""
    values, vectors = jnp.linalg.eigh(covariances)
    return vectors * jnp.sqrt(jnp.maximum(values, 0.0))[..., None, :]


@jax.jit
def _drawn(keys: jax.Array, anchors: jax.Array, relative: jax.Array, roots: jax.Array) -> jax.Array:
    """Draws (K, T, 7) about relative poses (K, T, 7) of anchors that have been drawn; keys are of frames."""
    unit = jax.vmap(jax.random.normal, (0, None), 1)(keys, (len(relative), 6))
    return _composed(anchors, _pulled(relative, jnp.einsum("ktij,ktj->kti", roots, unit)))


@jax.jit
def _by_ties(tied: PlacedKeyframes, ties: Ties) -> tuple[jax.Array, jax.Array]:
    """What other keyframes than the anchor add: displacements (G, T, 6) of frames, camera chart.

    Leaves of ties and of their keyframes are stacked (G, T, M, ...). Also how frames follow the distortion
    field (G, T, 6, F).
    """

    def of_mode(mode: tuple[PlacedKeyframes, Ties]) -> tuple[jax.Array, jax.Array]:
        def of_frame(frame: tuple[PlacedKeyframes, Ties]) -> tuple[jax.Array, jax.Array]:
            tied, ties = frame
            cameras = jax.vmap(_product)(tied.poses, jnp.asarray(ties.keyframes_from_camera))
            apart = jax.vmap(pose_gaussian.coordinates, (None, 0))(cameras[0], cameras)
            following = jax.vmap(pose_gaussian.carried_along)(ties.keyframes_from_camera) @ tied.sensitivity
            shares = jnp.where(tied.held[:, None, None] & tied.held[0], ties.shares, 0.0)
            return (
                jnp.einsum("mij,mj->i", shares, apart),
                jnp.einsum("mij,mjf->if", shares, following - following[:1]),
            )

        return jax.lax.map(of_frame, mode)

    return jax.lax.map(of_mode, (tied, ties))


@jax.jit
def _spread(
    anchors: PlacedKeyframes, relative: jax.Array, covariances: jax.Array, following: jax.Array
) -> jax.Array:
    """Covariances (G, T, 6, 6) of cameras at (G, T, 7) from anchors, whose leaves are (G, T, ...).

    Noise gives that of the anchors and the frames' own. Camera and anchor follow one field, the camera by
    (G, T, 6, F) itself.
    """

    def of_frame(frame: tuple[PlacedKeyframes, jax.Array, jax.Array, jax.Array]) -> jax.Array:
        anchor, relative, covariance, following = frame
        jacobian = pose_gaussian.carried_along(relative)
        noise = covariance + jacobian @ anchor.covariances @ jacobian.T
        field = following + jacobian @ anchor.sensitivity
        return noise + field @ field.T

    of_map = (anchors, relative, covariances, following)
    return jax.lax.map(lambda one: jax.lax.map(of_frame, one), of_map)


@jax.jit
def _marginals(poses: jax.Array, spread: jax.Array, probabilities: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Means (T, 7) of the likeliest of G maps, and second moments (T, 6, 6) of all of them about it."""
    mean = poses[jnp.argmax(probabilities)]
    apart = jax.vmap(jax.vmap(pose_gaussian.coordinates), (None, 0))(mean, poses)
    moments = spread + apart[..., :, None] * apart[..., None, :]
    return mean, jnp.einsum("g,gtij->tij", probabilities, moments)
