"""What a user may set about SLAM."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from recordings.settings import check_finite, check_within
from recordings.types import DepthNoise

Motion = Literal["free", "orbit"]

ProposalSource = Literal["enumerate", "kiss", "both"]

LEAST_PROBABILITY = 0.01
"""Search effort: less than one trajectory of 64 is drawn of a hypothesis that is not as probable as this."""

MOST_PARTICLES = 16384
"""Each has a pose for every frame: 4 GB after ten thousand."""


@dataclass(frozen=True, kw_only=True)
class SlamConfig:
    """Settings of the filter; the defaults hold for hand-held cameras, orbits and sparse views.

    Attributes:
        particles: K, trajectories that are drawn in the end.
        motion: prior over the camera's motion.
        orbit_radius_m: distance from the first camera to the orbit's pivot on its optical axis; None
            takes the depth at the image centre, loosely.
        proposal: where candidate poses come from.
        keyframes_compared: M, keyframes that each frame is compared with.
        noise: the sensor; None calibrates its sigma on the recording.
        effective_pixel_share: tempering exponent of the image density; None calibrates it.
        second_motion: look in every frame for a second rigid motion, where things move before the camera or
            along with it.

    Raises:
        ValueError: a value is out of its range.
    """

    particles: int = 64
    motion: Motion = "free"
    orbit_radius_m: float | None = None
    proposal: ProposalSource = "enumerate"
    keyframes_compared: int = 4
    noise: DepthNoise | None = None
    effective_pixel_share: float | None = None
    second_motion: bool = True

    def __post_init__(self) -> None:
        check_finite(self)
        check_within(self, 2, MOST_PARTICLES, ("particles",))
        if self.motion not in ("free", "orbit"):
            raise ValueError(f"motion must be free or orbit, got {self.motion!r}")
        if self.proposal not in ("enumerate", "kiss", "both"):
            raise ValueError(f"proposal must be enumerate, kiss or both, got {self.proposal!r}")
        if self.orbit_radius_m is not None and not self.orbit_radius_m > 0:
            raise ValueError(f"orbit_radius_m must be positive, got {self.orbit_radius_m}")
        if not 1 <= self.keyframes_compared <= 16:
            raise ValueError(f"keyframes_compared must be within 1..16, got {self.keyframes_compared}")
        share = self.effective_pixel_share
        if share is not None and not 0 < share <= 1:
            raise ValueError(f"effective_pixel_share must be within 0..1, got {share}")
