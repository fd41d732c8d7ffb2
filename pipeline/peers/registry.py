"""The peers by name, and running them: every setting is tried, the one with the least error counts."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics, Frame

Track = Callable[[Iterable[Frame], CameraIntrinsics], NDArray[np.float64]]
"""(frames, intrinsics) -> poses (T, 4, 4), the first frame's camera as reference."""


@dataclass(frozen=True)
class PeerRun:
    """A peer with its best setting on these frames.

    Attributes:
        name: of the peer and its setting.
        poses: (T, 4, 4), or None where every setting raised or left the numbers: the peer is lost.
        problem: what was wrong with the last.
    """

    name: str
    poses: NDArray[np.float64] | None
    problem: str = ""


def settings_of(name: str) -> dict[str, Track]:
    """The settings of a peer that are tried, by a name for each.

    Raises:
        KeyError: there is no such peer.
    """
    if name == "kiss-icp":
        from pipeline.peers.kiss_icp_odometry import track

        return {f"kiss-icp voxel {voxel:g} m": partial(track, voxel_m=voxel) for voxel in (0.03, 0.05, 0.1)}
    if name == "small-gicp":
        from pipeline.peers.small_gicp_map import track

        return {f"small-gicp VGICP map {voxel:g} m": partial(track, voxel_m=voxel) for voxel in (0.1, 0.2)}
    if name == "open3d":
        from pipeline.peers.open3d_tracking import track_model, track_odometry

        return {"open3d odometry": track_odometry, "open3d TSDF model": track_model}
    raise KeyError(name)


def best_of(
    name: str,
    frames: Iterable[Frame],
    intrinsics: CameraIntrinsics,
    error: Callable[[NDArray[np.float64]], float],
) -> PeerRun:
    """A peer's best result by `error`; settings that raise, or leave the numbers, are lost."""
    runs: list[tuple[float, PeerRun]] = []
    problem = ""
    for setting, track in settings_of(name).items():
        try:
            poses = track(frames, intrinsics)
        except Exception as raised:
            problem = f"{type(raised).__name__}: {raised}"
            continue
        if not np.isfinite(poses).all():
            problem = "its poses are not finite"
            continue
        runs.append((error(poses), PeerRun(setting, poses)))
    if not runs:
        return PeerRun(name, None, problem)
    return min(runs, key=lambda run: run[0])[1]
