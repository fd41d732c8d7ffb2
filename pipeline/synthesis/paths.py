"""Camera paths: where a camera that films an object or a table stands at each frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from recordings.settings import check_finite, check_within


@dataclass(frozen=True, kw_only=True)
class PathConfig:
    """How the camera moves round the point it looks at.

    Attributes:
        kind: `orbit` keeps distance and elevation and steps by `degrees_per_frame`; `handheld` wanders
            and shakes; `rings` are few views spread evenly over whole circles, one for each elevation.
        frames: number of views.
        degrees_per_frame: step of azimuth of `orbit`, mean step of `handheld`.
        uneven: by up to which share of it each step of `orbit` is longer or shorter; the mean stays.
        radius_m: distance to the point looked at.
        elevations_deg: angles above the horizon: one for each of the `rings`; else passed through evenly
            from the first frame to the last.
        start_deg: azimuth of the first view; None draws it.
        look_at_error_deg: standard deviation of the aim about both image axes.
        shake_m: standard deviation of the hand's tremor (`handheld`).
        shake_deg: the same about each axis.
        frames_per_second: distance of the stamps.
    """

    kind: Literal["orbit", "handheld", "rings"] = "orbit"
    frames: int = 60
    degrees_per_frame: float = 6.0
    uneven: float = 0.0
    radius_m: float = 1.0
    elevations_deg: tuple[float, ...] = (30.0,)
    start_deg: float | None = None
    look_at_error_deg: float = 0.0
    shake_m: float = 0.003
    shake_deg: float = 0.4
    frames_per_second: float = 30.0

    def __post_init__(self) -> None:
        check_finite(self)
        check_within(self, 0.0, 1.0, ("uneven",))
        check_within(self, 0.0, 90.0, ("look_at_error_deg", "shake_m", "shake_deg"))
        if self.frames < 1:
            raise ValueError(f"frames must be at least 1, got {self.frames}")
        if self.radius_m <= 0 or self.frames_per_second <= 0:
            raise ValueError("radius_m and frames_per_second must be positive")
        if not self.elevations_deg or max(map(abs, self.elevations_deg)) >= 90:
            raise ValueError(f"elevations_deg must lie inside (-90, 90), got {self.elevations_deg}")


def camera_path(
    config: PathConfig, target_m: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Poses world_from_camera (T, 4, 4) looking at `target_m` (3,); the world's z points up."""
    start = rng.uniform(0, 2 * np.pi) if config.start_deg is None else np.radians(config.start_deg)
    if config.kind == "rings":
        poses = _rings(config, target_m, start)
    elif config.kind == "orbit":
        azimuth = start + np.radians(config.degrees_per_frame) * _steps_walked(config, rng)
        poses = _looking_at(_on_sphere(target_m, config.radius_m, azimuth, _climb(config)), target_m)
    else:
        poses = _hand_held(config, target_m, start, rng)
    aim = rng.normal(scale=np.radians(config.look_at_error_deg), size=(config.frames, 2))
    poses[:, :3, :3] @= Rotation.from_rotvec(np.pad(aim, ((0, 0), (0, 1)))).as_matrix()
    return poses


def _steps_walked(config: PathConfig, rng: np.random.Generator) -> NDArray[np.float64]:
    """Mean steps (T,) from the first frame to each; with the one that would close a circle they are T."""
    if not config.uneven:
        return np.arange(config.frames, dtype=float)
    steps = 1.0 + rng.uniform(-config.uneven, config.uneven, config.frames)
    return np.append(0.0, np.cumsum(steps)[:-1]) / steps.mean()


def _rings(config: PathConfig, target_m: NDArray[np.float64], start: float) -> NDArray[np.float64]:
    rings = len(config.elevations_deg)
    counts = [len(range(ring, config.frames, rings)) for ring in range(rings)]
    positions = [
        _on_sphere(
            target_m,
            config.radius_m,
            start + 2 * np.pi * (np.arange(count) + ring / rings) / max(count, 1),
            elevation,
        )
        for ring, (count, elevation) in enumerate(zip(counts, config.elevations_deg, strict=True))
    ]
    return _looking_at(np.concatenate(positions), target_m)


def _climb(config: PathConfig) -> NDArray[np.float64]:
    """Elevation (T,) in degrees of a path that passes through all of them."""
    knots = np.linspace(0, config.frames - 1, len(config.elevations_deg))
    return np.interp(np.arange(config.frames), knots, config.elevations_deg)


def _hand_held(
    config: PathConfig, target_m: NDArray[np.float64], start: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Slow wandering of azimuth, elevation, distance and aim, with a tremor on top."""
    slow = config.frames_per_second
    step = np.radians(config.degrees_per_frame) * (1 + 0.5 * _smooth_noise(rng, config.frames, 1, slow)[:, 0])
    azimuth = start + np.cumsum(step) - step[0]
    wander = _smooth_noise(rng, config.frames, 5, slow)
    elevation = np.clip(_climb(config) + 6 * wander[:, 0], -85, 85)
    radius = config.radius_m * np.exp(0.06 * wander[:, 1])
    poses = _looking_at(_on_sphere(target_m, radius, azimuth, elevation), target_m + 0.03 * wander[:, 2:])
    tremor = _smooth_noise(rng, config.frames, 6, 1.5)
    poses[:, :3, 3] += config.shake_m * tremor[:, :3]
    poses[:, :3, :3] @= Rotation.from_rotvec(np.radians(config.shake_deg) * tremor[:, 3:]).as_matrix()
    return poses


def _smooth_noise(
    rng: np.random.Generator, frames: int, channels: int, correlation_frames: float
) -> NDArray[np.float64]:
    """Gaussian noise (frames, channels) of unit variance, correlated over about `correlation_frames`."""
    margin = int(np.ceil(4 * correlation_frames))
    white = rng.normal(size=(frames + 2 * margin, channels))
    impulse = np.zeros(2 * margin + 1)
    impulse[margin] = 1.0
    gain = np.sqrt((gaussian_filter1d(impulse, correlation_frames) ** 2).sum())
    return gaussian_filter1d(white, correlation_frames, axis=0)[margin : margin + frames] / gain


def _on_sphere(
    centre_m: NDArray[np.float64],
    radius_m: float | NDArray[np.float64],
    azimuth_rad: NDArray[np.float64],
    elevation_deg: float | NDArray[np.float64],
) -> NDArray[np.float64]:
    elevation = np.radians(elevation_deg)
    offsets = [
        np.cos(elevation) * np.cos(azimuth_rad),
        np.cos(elevation) * np.sin(azimuth_rad),
        np.sin(elevation),
    ]
    return centre_m + np.stack(np.broadcast_arrays(*offsets), axis=-1) * np.asarray(radius_m)[..., None]


def level_rotations(
    yaw_rad: NDArray[np.float64], pitch_rad: NDArray[np.float64] | float
) -> NDArray[np.float64]:
    """Rotations world_from_camera (T, 3, 3), z up, of cameras that look so far down and do not roll."""
    ahead = np.cos(yaw_rad) * np.cos(pitch_rad), np.sin(yaw_rad) * np.cos(pitch_rad), -np.sin(pitch_rad)
    forward = np.stack(np.broadcast_arrays(*ahead), axis=1)
    right = np.stack([np.sin(yaw_rad), -np.cos(yaw_rad), 0 * yaw_rad], axis=1)
    return np.stack([right, np.cross(forward, right), forward], axis=2)


def _looking_at(positions_m: NDArray[np.float64], targets_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Upright cameras (T, 4, 4) at positions (T, 3) that look at targets: z forward, y down."""
    forward = targets_m - positions_m
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    poses = np.tile(np.eye(4), (len(positions_m), 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    poses[:, :3, 3] = positions_m
    return poses
