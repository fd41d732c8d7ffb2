"""A place found for a frame, and when it is to be believed."""

from __future__ import annotations

from dataclasses import dataclass
from operator import attrgetter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recordings.types import DepthNoise
from shapes.geometry import pose_sets
from shapes.geometry.poses import matrices_of
from slam.likelihood.image_density import STRIDE_PX, log_pixel_factors
from slam.registration.local_map import LocalMap
from slam.registration.local_search import Optimum, block_membership

CONVINCING_EXPLAINED = 0.75
"""Chosen by hand."""

CONVINCING_COVERED = 0.2
"""An optimum near the prediction is taken without a further search if this share of the returns meets the
map and that share of those lies on it."""

UNMISTAKABLE_EXPLAINED = 0.92
"""The same after a wide step, when a wrong place explains up to 0.89 of a view round an object (measured)."""

PLAUSIBLE_EXPLAINED = 0.6
"""Chosen by hand; what is below is worth no refinement."""

PLAUSIBLE_COVERED = 0.1
"""The least with which the camera counts as found at all."""

SAME_SHIFT_M, SAME_ANGLE_RAD = 0.02, 0.02
"""Optima closer than this are one place."""

NEGLIGIBLE_LOG_SHARE = 15.0
"""exp(-15) is far less than a hypothesis must weigh."""


@dataclass(frozen=True)
class Registration:
    """An optimum and what it was compared with.

    Attributes:
        optimum: of the image density.
        indices: (M,) keyframes; the first is the closest view.
        local_map: their surfaces and poses.
    """

    optimum: Optimum
    indices: NDArray[np.int_]
    local_map: LocalMap

    @property
    def explained(self) -> float:
        """Share of the returns on the map's surface."""
        return float(self.optimum.agreement.explained)

    @property
    def covered(self) -> float:
        """Share of the returns that meet the map."""
        return float(self.optimum.agreement.covered)

    @property
    def log_density(self) -> float:
        """Of the image there; minus infinity where alignment left the numbers."""
        return float(self.optimum.log_density) if self.is_finite else -np.inf

    def log_density_of_blocks(self, noise: DepthNoise) -> NDArray[np.float64]:
        """The same (B,), by blocks of pixels. `noise` is the sensor's."""
        pose = self.optimum.pose
        factors, _ = log_pixel_factors(self.optimum.pixels, self.local_map.keyframes_from_camera(pose), noise)
        blocks = np.asarray(factors, np.float64) @ block_membership(STRIDE_PX)
        return blocks if self.is_finite else np.full_like(blocks, -np.inf)

    @property
    def is_finite(self) -> bool:
        """Whether alignment stayed within the numbers: a start that sees next to nothing may leave them."""
        return bool(np.isfinite(np.append(self.optimum.pose, self.optimum.log_density)).all())

    def is_within(self, shift_m: float, angle_rad: float, pose: ArrayLike) -> bool:
        """Whether it is so near a pose (7,)."""
        start, found = matrices_of(np.asarray(pose)), matrices_of(self.optimum.pose)
        return bool(pose_sets.within_reach(start, found, shift_m, angle_rad))

    @property
    def is_accepted(self) -> bool:
        """No need to look elsewhere."""
        return self.covered >= CONVINCING_COVERED and self.explained >= CONVINCING_EXPLAINED * self.covered

    @property
    def is_unambiguous(self) -> bool:
        """No need to look elsewhere, even where the camera may be far from where it is expected."""
        return self.is_accepted and self.explained >= UNMISTAKABLE_EXPLAINED * self.covered

    @property
    def weakest_share(self) -> float:
        """Precision of the translation that pixels hold least, over the mean of all."""
        translations = np.asarray(self.optimum.layer_precisions, np.float64).sum(axis=0)[:3, :3]
        return float(np.linalg.eigvalsh(translations)[0] / max(np.trace(translations) / 3.0, 1e-12))

    @property
    def is_plausible(self) -> bool:
        """Fit to be believed at all."""
        return self.covered >= PLAUSIBLE_COVERED and self.explained >= PLAUSIBLE_EXPLAINED * self.covered


def suppress_duplicates(found: list[Registration]) -> list[Registration]:
    """Optima that differ from each other, the best first; those that left the numbers are dropped."""
    finite = [located for located in found if located.is_finite]
    ranked = sorted(finite, key=attrgetter("log_density"), reverse=True)
    if not ranked:
        return []
    poses = np.stack([matrices_of(located.optimum.pose) for located in ranked])
    return [ranked[i] for i in pose_sets.suppress_similar(poses, len(ranked), SAME_SHIFT_M, SAME_ANGLE_RAD)]


def prune_improbable(found: list[Registration], exponent: float) -> list[Registration]:
    """Plausible optima whose tempered share is not negligible beside the best one's."""
    plausible = [located for located in found if located.is_plausible]
    if not plausible:
        return []
    best = max(located.log_density for located in plausible)
    limit = NEGLIGIBLE_LOG_SHARE / exponent
    return [located for located in plausible if located.log_density > best - limit]
