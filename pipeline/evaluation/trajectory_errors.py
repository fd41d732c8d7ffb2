"""Errors of an estimated trajectory against a reference: absolute, relative, and coverage of its regions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial.transform import Rotation

from recordings.types import Trajectory

LEVELS = (0.5, 0.9, 0.95)
APART_NS = 20_000_000
"""A frame and a reference pose farther apart are not of one time."""


@dataclass(frozen=True, kw_only=True)
class TrajectoryErrors:
    """How far a trajectory is from its reference.

    Attributes:
        frames: compared, of those that both have.
        ate_m: root mean square distance of positions after the best rigid alignment (Umeyama, no scale).
        ate_first_pose_m: the same with only the first poses aligned.
        rpe_translation_m: root mean square translation error of the motion between successive frames.
        rpe_rotation_rad: the same of rotations.
    """

    frames: int
    ate_m: float
    ate_first_pose_m: float
    rpe_translation_m: float
    rpe_rotation_rad: float


def matched(times_ns: NDArray[np.int64], reference: Trajectory) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """Indices of frames and of the reference poses nearest to them in time, within `APART_NS`."""
    order = np.argsort(reference.times_ns, kind="stable")
    sorted_times = reference.times_ns[order]
    after = np.clip(np.searchsorted(sorted_times, times_ns), 1, max(len(sorted_times) - 1, 1))
    after = np.minimum(after, len(sorted_times) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(sorted_times[before] - times_ns) <= np.abs(sorted_times[after] - times_ns)
    nearest = np.where(nearer, before, after)
    close = np.abs(sorted_times[nearest] - times_ns) <= APART_NS
    return np.nonzero(close)[0], order[nearest[close]]


def trajectory_errors(estimate: NDArray[np.float64], reference: NDArray[np.float64]) -> TrajectoryErrors:
    """Errors of poses (T, 4, 4) against reference poses (T, 4, 4) of the same frames.

    Raises:
        ValueError: there are not at least two frames.
    """
    if len(estimate) < 2 or len(estimate) != len(reference):
        raise ValueError(f"need at least two frames of both, got {len(estimate)} and {len(reference)}")
    aligned = rigid_alignment(estimate[:, :3, 3], reference[:, :3, 3]) @ estimate
    first = reference[0] @ np.linalg.inv(estimate[0]) @ estimate
    relative = np.linalg.inv(_steps(reference)) @ _steps(estimate)
    return TrajectoryErrors(
        frames=len(estimate),
        ate_m=_root_mean_square(aligned[:, :3, 3] - reference[:, :3, 3]),
        ate_first_pose_m=_root_mean_square(first[:, :3, 3] - reference[:, :3, 3]),
        rpe_translation_m=_root_mean_square(relative[:, :3, 3]),
        rpe_rotation_rad=_root_mean_square(Rotation.from_matrix(relative[:, :3, :3]).as_rotvec()),
    )


def rotation_errors_rad(estimate: NDArray[np.float64], reference: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles (T,) between the orientations of poses (T, 4, 4) after the turn that aligns them best.

    That turn is the mean of the relative rotations: positions do not fix it about a straight path.
    """
    true, found = (Rotation.from_matrix(poses[:, :3, :3]) for poses in (reference, estimate))
    turn = (true * found.inv()).mean()
    return (true.inv() * turn * found).magnitude()


def rigid_alignment(source: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rigid transform (4, 4) that brings points (n, 3) closest to others (Umeyama 1991, scale 1)."""
    source_mean, target_mean = source.mean(0), target.mean(0)
    u, _, vt = np.linalg.svd((target - target_mean).T @ (source - source_mean))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = target_mean - rotation @ source_mean
    return transform


def squared_distances(
    mean: NDArray[np.float64], covariance: NDArray[np.float64], truth: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Mahalanobis distances squared (T,) of true poses (T, 4, 4) under marginals in the mean's tangent.

    Directions in which a marginal has no spread at all count only if the truth differs there.
    """
    relative = np.linalg.inv(mean) @ truth
    rotation = Rotation.from_matrix(relative[:, :3, :3]).as_rotvec()
    tangent = np.concatenate([relative[:, :3, 3], rotation], axis=1)
    ridge = 1e-12 * np.eye(6)
    solved = np.linalg.solve(covariance + ridge, tangent[..., None])[..., 0]
    return (tangent * solved).sum(1)


def largest_squared_distance(level: float, degrees_of_freedom: float, dimensions: int = 6) -> float:
    """Mahalanobis distance squared at the edge of a multivariate Student-t's region of that level.

    For t = N(0, S) / sqrt(chi2_nu / nu) in d dimensions, t^T S^-1 t / d is F(d, nu) and the covariance is
    S nu / (nu - 2) (Kotz and Nadarajah 2004, section 1.2), nu > 2.
    """
    edge = float(stats.f.ppf(level, dimensions, degrees_of_freedom))
    return dimensions * (1.0 - 2.0 / degrees_of_freedom) * edge


def level_of(squared_distance: float, degrees_of_freedom: float) -> float:
    """The level of the region that a pose at this Mahalanobis distance squared is on the edge of."""
    ratio = squared_distance / (6 * (1.0 - 2.0 / degrees_of_freedom))
    return float(stats.f.cdf(ratio, 6, degrees_of_freedom))


def coverage(squared: NDArray[np.float64], degrees_of_freedom: float) -> dict[float, float]:
    """Share of distances squared (T,) inside the regions of each of `LEVELS`."""
    return {
        level: float((squared <= largest_squared_distance(level, degrees_of_freedom)).mean())
        for level in LEVELS
    }


def _steps(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.linalg.inv(poses[:-1]) @ poses[1:]


def _root_mean_square(vectors: NDArray[np.float64]) -> float:
    return float(np.sqrt((vectors**2).sum(-1).mean()))
