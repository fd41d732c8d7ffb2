"""Settings of learning a shape."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from recordings.settings import check_finite
from recordings.types import DepthNoise

MOST_VOXELS = 2e7
"""Of a box: a cube of 1.35 m at 5 mm. Of what stands in it so many as `region.LARGEST_GRID` are learned."""


@dataclass(frozen=True, kw_only=True)
class LearnConfig:
    """How a shape is learned.

    Attributes:
        pitch_m: edge of a voxel.
        box: object region xmin, ymin, zmin, xmax, ymax, zmax in metres in the reference frame (the
            camera of the first frame that was found); None finds it.
        pixel: column and row of the object in the first frame that is learned from; None takes what the
            cameras look at.
        views: at most so many frames are used, spread evenly over the recording.
        trajectories: at most so many particles are distilled, drawn by their weights.
        prior_occupied: p0, of a voxel that was never seen.
        hidden_occupied: p_hidden, of a voxel hidden behind seen surface in every view.
        partly_filled: share of empty voxels that hold some surface all the same.
        partial_opacity: probability that a ray through such a voxel ends there.
        walled: share of empty voxels that a wall passes on one side of the centre, thinner than a voxel.
        unresolved: share of returns from surfaces that no voxel stands for.
        registration_sigma_m: standard deviation of a view's registration along its rays, at best.
        shared_sigma_m: standard deviation of the error along their rays that all views share.
        tracking_sigma_m: what tracking adds to it; left out where the poses are recorded ones.
        sweeps: of expectation propagation.
        damping: of expectation propagation.
        noise: the depth sensor.
    """

    pitch_m: float = 0.005
    box: tuple[float, float, float, float, float, float] | None = None
    pixel: tuple[float, float] | None = None
    views: int = 40
    trajectories: int = 4
    prior_occupied: float = 0.5
    hidden_occupied: float = 0.9
    partly_filled: float = 0.2
    partial_opacity: float = 0.5
    walled: float = 0.1
    unresolved: float = 0.02
    registration_sigma_m: float = 0.0004
    tracking_sigma_m: float = 0.0007
    shared_sigma_m: float = 0.00015
    sweeps: int = 20
    damping: float = 0.3
    noise: DepthNoise = field(default_factory=DepthNoise)

    def __post_init__(self) -> None:
        check_finite(self)
        if not 0.001 <= self.pitch_m <= 0.1:
            raise ValueError(f"pitch_m must lie in [0.001, 0.1], got {self.pitch_m}")
        if self.box is not None and not all(
            low < high for low, high in zip(self.box[:3], self.box[3:], strict=True)
        ):
            raise ValueError("box must be xmin,ymin,zmin,xmax,ymax,zmax with each min below its max")
        if self.box is not None:
            sides = [high - low for low, high in zip(self.box[:3], self.box[3:], strict=True)]
            voxels = math.prod(side / self.pitch_m for side in sides)
            if voxels > MOST_VOXELS:
                raise ValueError(
                    f"box holds {voxels:.3g} voxels of {self.pitch_m:g} m, at most {MOST_VOXELS:g} fit; "
                    "take a smaller box or a larger pitch_m"
                )
        for name in ("views", "trajectories", "sweeps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("prior_occupied", "hidden_occupied", "partial_opacity"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"{name} must lie between 0 and 1, got {getattr(self, name)}")
        for name in ("partly_filled", "walled", "unresolved"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} must lie in [0, 1), got {getattr(self, name)}")
        if self.partly_filled + self.walled >= 1:
            raise ValueError(
                "partly_filled and walled are shares of the empty voxels and must leave some of them, got "
                f"{self.partly_filled} and {self.walled}"
            )
        if not 0 < self.damping <= 1:
            raise ValueError(f"damping must lie in (0, 1], got {self.damping}")
        for name in ("registration_sigma_m", "tracking_sigma_m", "shared_sigma_m"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")

    def with_noise(self, noise: DepthNoise | None) -> LearnConfig:
        """The same for a sensor that is known, unless another noise was set."""
        return self if noise is None or self.noise != DepthNoise() else replace(self, noise=noise)

    @property
    def for_tracked_poses(self) -> LearnConfig:
        """The same where the poses come from tracking and not from elsewhere."""
        sigma = math.hypot(self.registration_sigma_m, self.tracking_sigma_m)
        return replace(self, registration_sigma_m=sigma)
