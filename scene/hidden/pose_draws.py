"""Weighted draws of hidden objects' poses: of all, or of those alone that a rough look does not rule out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scene.hidden.depth_evidence import DepthImages
from scene.hidden.pose_priors import PosePrior
from scene.objects.scene_object import SceneObject

RENDERED_TOGETHER = 1024
"""Poses that are rendered together, so that memory does not grow with their number."""

LOOKED_AT_TOGETHER = 2**16
"""Poses that are looked at together, for the same reason."""

SURE_NATS = 12.0
"""By which a pose may be worse in the rough look and is rendered for certain: four of its points may be taken
for seen."""

LEAST_KEPT = 1 / 64
"""Chance of being rendered that every pose has: the rough look errs about what is smaller than a pixel."""

WeighedPoses = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Poses (n, K, 4, 4) of n objects, and the log (K,) of prior over proposal times likelihood ratio."""


class PoseDraws(Protocol):
    """Where poses come from."""

    @property
    def together(self) -> int:
        """Draws that are best made at once."""
        ...

    def draw(self, rng: np.random.Generator, count: int) -> WeighedPoses:
        """So many draws, or fewer: the weights of those left out are zero."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class PriorDraws:
    """One object or two, from their prior, all rendered."""

    objects: Sequence[SceneObject]
    prior: PosePrior
    images: DepthImages
    together: int = RENDERED_TOGETHER

    def draw(self, rng: np.random.Generator, count: int) -> WeighedPoses:
        """As `PoseDraws`."""
        drawn = self.prior.draw(rng, self.objects, count)
        log_weights = self.images.log_ratios(self.objects[0], drawn[0])
        if len(self.objects) == 2:
            log_weights += self.images.log_ratios_behind(self.objects[1], drawn[1], self.objects[0], drawn[0])
        return drawn, log_weights


@dataclass(frozen=True, kw_only=True, eq=False)
class RouletteDraws:
    """One object, whose poses are rendered with a probability that falls with a rough look's verdict.

    Dividing the weights by it keeps their mean: Russian roulette (Kahn 1950).

    Attributes:
        one: the object.
        prior: of its poses.
        images: what was seen.
    """

    one: SceneObject
    prior: PosePrior
    images: DepthImages
    together: int = LOOKED_AT_TOGETHER

    def draw(self, rng: np.random.Generator, count: int) -> WeighedPoses:
        """As `PoseDraws`."""
        poses = self.prior.draw(rng, [self.one], count)[0]
        rough = self.images.rough_log_ratios(self.one, poses)
        log_kept = np.clip(rough + SURE_NATS, np.log(LEAST_KEPT), 0.0)
        kept = np.log(rng.uniform(size=count)) < log_kept
        poses = poses[kept]
        return poses[None], self._rendered(poses) - log_kept[kept]

    def _rendered(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log ratios (n,), in batches of one size: one kernel serves them all."""
        batches = np.resize(poses, (-(-len(poses) // RENDERED_TOGETHER), RENDERED_TOGETHER, 4, 4))
        ratios = [np.zeros(0), *(self.images.log_ratios(self.one, batch) for batch in batches)]
        return np.concatenate(ratios)[: len(poses)]


DrawsOf = Callable[[Sequence[SceneObject], PosePrior, DepthImages, int], PoseDraws]
"""Of objects, their prior, what was seen, and the number of draws: where poses come from."""


def pose_draws(
    objects: Sequence[SceneObject], prior: PosePrior, images: DepthImages, draws: int
) -> PoseDraws:
    """From the prior, as suits so many draws."""
    if len(objects) > 1 or draws <= RENDERED_TOGETHER:
        return PriorDraws(objects=objects, prior=prior, images=images)
    return RouletteDraws(one=objects[0], prior=prior, images=images)
