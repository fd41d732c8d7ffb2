"""Weighted draws of hidden objects' poses: of all, or of those alone that a rough look does not rule out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scene.hidden.depth_evidence import DepthImages
from scene.hidden.point_proposals import PosesThroughPoints
from scene.hidden.pose_priors import EulerUniformPoses, PosePrior
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

PILOT_ROUNDS = 4
"""Of `LOOKED_AT_TOGETHER` draws, or of all if those are fewer, after each of which the shares of points are
fitted: those of points that matter are then known to a tenth or two. The mean does not count these draws."""

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
        proposal: from which poses are drawn; the prior where None.
    """

    one: SceneObject
    prior: PosePrior
    images: DepthImages
    proposal: PosesThroughPoints | None = None
    together: int = LOOKED_AT_TOGETHER

    def draw(self, rng: np.random.Generator, count: int) -> WeighedPoses:
        """As `PoseDraws`."""
        given = self.proposal
        poses = given.draw(rng, self.one, count) if given else self.prior.draw(rng, [self.one], count)[0]
        rough = self.images.rough_log_ratios(self.one, poses)
        log_kept = np.clip(rough + SURE_NATS, np.log(LEAST_KEPT), 0.0)
        kept = np.log(rng.uniform(size=count)) < log_kept
        poses, log_weights = poses[kept], -log_kept[kept]
        if given:
            log_weights += given.log_weights(poses)
        return poses[None], log_weights + self._rendered(poses)

    def _rendered(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log ratios (n,), in batches of one size: one kernel serves them all."""
        filled = poses[
            np.arange(-(-len(poses) // RENDERED_TOGETHER) * RENDERED_TOGETHER) % max(len(poses), 1)
        ]
        batches = filled.reshape(-1, RENDERED_TOGETHER, 4, 4)
        ratios = [np.zeros(0), *(self.images.log_ratios(self.one, batch) for batch in batches)]
        return np.concatenate(ratios)[: len(poses)]


def pose_draws(
    rng: np.random.Generator,
    objects: Sequence[SceneObject],
    prior: PosePrior,
    images: DepthImages,
    draws: int,
) -> PoseDraws:
    """What suits so many draws; through unexplained points where there are any and the prior is uniform."""
    if len(objects) > 1 or draws <= RENDERED_TOGETHER:
        return PriorDraws(objects=objects, prior=prior, images=images)
    one = objects[0]
    proposal = None
    if isinstance(prior, EulerUniformPoses):
        proposal = PosesThroughPoints.even(one, prior, images.unexplained_points_m())
    if proposal:
        proposal = _fitted(rng, one, prior, images, proposal, min(LOOKED_AT_TOGETHER, draws))
    return RouletteDraws(one=one, prior=prior, images=images, proposal=proposal)


def _fitted(
    rng: np.random.Generator,
    one: SceneObject,
    prior: PosePrior,
    images: DepthImages,
    proposal: PosesThroughPoints,
    draws: int,
) -> PosesThroughPoints:
    """The proposal fitted to all rounds of so many draws so far, each of which weighs the same."""
    poses, log_weights = np.zeros((0, 4, 4)), np.zeros(0)
    for _ in range(PILOT_ROUNDS):
        pilot = RouletteDraws(one=one, prior=prior, images=images, proposal=proposal)
        drawn, log_drawn = pilot.draw(rng, draws)
        poses, log_weights = np.concatenate([poses, drawn[0]]), np.concatenate([log_weights, log_drawn])
        proposal = proposal.fitted(rng, poses, log_weights)
    return proposal
