"""Distilling the particles' shapes into one prior (3DP3, supplement I).

KL(p || q_phi) is least where every phi is the mean of the particles' probabilities under their weights,
phi* = sum_k w_k p(O = 1 | M_k, x_k, I), and every surfel has the mixture's moments.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from recordings.types import CameraIntrinsics, Frame
from shapes.learning.checkpoint import LearnCheckpoint
from shapes.learning.colouring import voxel_colours
from shapes.learning.config import LearnConfig
from shapes.learning.occupancy import Occupancy, occupancy, windows
from shapes.learning.region import object_grid
from shapes.learning.surfels import distil_surfels
from shapes.prior import ShapePrior
from shapes.resampling import resample_systematically
from shapes.voxel_grid import VoxelGrid

BORDER = 2
"""Voxels round what was seen occupied."""
SPECK = 0.02
"""Seen-occupied voxels apart from the largest piece count as object from this share of its size."""


def distil(phi: ArrayLike, log_weights: ArrayLike) -> NDArray[np.float64]:
    """phi* (...) of probabilities (K, ...) under normalised log weights (K,)."""
    return np.tensordot(np.exp(np.asarray(log_weights)), np.asarray(phi), axes=1)


def select_views(total: int, config: LearnConfig) -> NDArray[np.intp]:
    """Numbers of the frames that are learned from, spread evenly over all `total`."""
    return np.unique(np.round(np.linspace(0, total - 1, min(config.views, total))).astype(np.intp))


def learn_shape(
    key: jax.Array,
    frames: Iterable[Frame],
    intrinsics: CameraIntrinsics,
    trajectories: NDArray[np.float64],
    log_weights: NDArray[np.float64],
    config: LearnConfig,
    on_trajectory: Callable[[int, int], None] | None = None,
    *,
    checkpoint: LearnCheckpoint | None = None,
    on_checkpoint: Callable[[LearnCheckpoint], None] | None = None,
) -> ShapePrior:
    """Learn the shape of one object.

    Args:
        key: draws the trajectories that are distilled.
        frames: T depth frames.
        intrinsics: of their camera.
        trajectories: (K, T, 4, 4) reference_from_camera.
        log_weights: (K,) normalised.
        config: settings.
        on_trajectory: called with the number of distilled trajectories done and in all.
        checkpoint: of the same call, from which to go on.
        on_checkpoint: called with what is known after each trajectory.

    Raises:
        ValueError: there is no object to learn; the message says why.
    """
    total = trajectories.shape[1]
    chosen = select_views(total, config)
    wanted = set(chosen.tolist())
    kept = [frame for number, frame in enumerate(frames) if number in wanted]
    if len(kept) != len(chosen):
        raise ValueError(f"the trajectory has {total} poses, the recording fewer frames")
    depths = [frame.depth_m for frame in kept]
    poses = trajectories[:, chosen]
    best = poses[int(np.argmax(log_weights))]
    grid = object_grid(depths, intrinsics, best, config)
    views = windows(depths, intrinsics, grid, best, config)
    particles, weights = _drawn(key, poses, log_weights, config.trajectories)
    found = [] if checkpoint is None else checkpoint.found
    for number, particle in enumerate(particles[len(found) :], len(found) + 1):
        found.append(occupancy(views, intrinsics, grid, particle, config))
        if on_trajectory is not None:
            on_trajectory(number, len(particles))
        if on_checkpoint is not None:
            on_checkpoint(LearnCheckpoint.of(found))
    return _prior(found, weights, grid, kept, intrinsics, best)


def _drawn(
    key: jax.Array, poses: NDArray[np.float64], log_weights: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distinct trajectories and their weights: all, or a systematic sample of `count` by weight."""
    weights = np.exp(log_weights - np.max(log_weights))
    weights /= weights.sum()
    if len(poses) > count:
        drawn = np.asarray(resample_systematically(key, jnp.log(jnp.asarray(weights)), count))
        weights = np.bincount(drawn, minlength=len(poses)) / count
    held = np.flatnonzero(weights > 0)
    distinct, index = np.unique(poses[held].reshape(len(held), -1), axis=0, return_inverse=True)
    shares = np.zeros(len(distinct))
    np.add.at(shares, index.reshape(-1), weights[held])
    return distinct.reshape(-1, *poses.shape[1:]), shares


def _prior(
    found: Sequence[Occupancy],
    weights: NDArray[np.float64],
    grid: VoxelGrid,
    frames: Sequence[Frame],
    intrinsics: CameraIntrinsics,
    reference_from_camera: NDArray[np.float64],
) -> ShapePrior:
    log_weights = np.log(weights)
    phi = distil([one.phi for one in found], log_weights).reshape(grid.shape)
    seen = distil([one.seen for one in found], log_weights).reshape(grid.shape) > 0.5
    hidden = distil([one.hidden for one in found], log_weights).reshape(grid.shape) > 0.5
    occupied = seen & (phi > 0.5)
    box = _object_box(occupied)
    inner = tuple(slice(*axis) for axis in box.T)
    cropped = grid.cropped(*box)
    colours = voxel_colours(occupied[inner], cropped, frames, intrinsics, reference_from_camera)
    return ShapePrior(
        phi=np.ascontiguousarray(np.clip(phi[inner], 0.0, 1.0), np.float32),
        pitch_m=grid.pitch_m,
        reference_from_grid=cropped.reference_from_grid,
        seen_free=np.ascontiguousarray((seen & ~occupied)[inner]),
        seen_occupied=np.ascontiguousarray(occupied[inner]),
        enclosed=np.ascontiguousarray((hidden & ~seen)[inner]),
        rgb=colours,
        surfels=distil_surfels([one.surfels for one in found], weights).cropped(grid.shape, *box),
    )


def _object_box(occupied: NDArray[np.bool_]) -> NDArray[np.intp]:
    """First voxel and the one after the last (2, 3) of the seen-occupied ones and a border.

    Raises:
        ValueError: nothing was seen occupied.
    """
    if not occupied.any():
        raise ValueError("no voxel was seen occupied: the object is smaller than the pitch, or out of sight")
    label = np.zeros(occupied.shape, np.int32)
    ndimage.label(occupied, np.ones((3, 3, 3)), output=label)
    sizes = np.bincount(label.ravel())
    sizes[0] = 0
    object_ = np.argwhere((sizes >= SPECK * sizes.max())[label])
    low = np.maximum(object_.min(axis=0) - BORDER, 0)
    return np.stack([low, np.minimum(object_.max(axis=0) + 1 + BORDER, occupied.shape)])
