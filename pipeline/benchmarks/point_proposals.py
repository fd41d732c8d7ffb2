"""Poses in which an object explains what nothing known explains: there its likelihood is high, if anywhere.

Prior poses in which an object is out of sight have a likelihood ratio of one. Those in which it just shows
itself, in a pixel that nothing known explains, are rare, and their ratio is in the hundreds: few of them
carry a part of the mean. A mixture of the prior and of poses through such points finds them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pipeline.benchmarks.pose_kernels import PoseKernels
from recordings.types import DepthNoise
from scene.hidden.depth_evidence import DepthImages
from scene.hidden.pose_draws import (
    LOOKED_AT_TOGETHER,
    PoseDraws,
    RouletteDraws,
    WeighedPoses,
    pose_draws,
)
from scene.hidden.pose_priors import EulerUniformPoses, PosePrior
from scene.objects.scene_object import SceneObject
from scene.observation.depth_view import unproject
from shapes import depth_noise
from shapes.geometry.poses import transform_points

UNEXPLAINED_NATS = 3.0
"""By which a surface at the measured depth explains a pixel better than what is known, or more."""

PRIOR_SHARE = 0.25
"""Of the mixture's draws: it bounds the weights."""

KERNEL_SHARE = 0.1
"""Of the mixture's draws, from kernels where there are any; the rest goes through points."""

KERNELS = 128
"""Poses that kernels are put round. Search effort."""

LEAST_SHARE = 0.3
"""Of those draws, that is spread evenly over the points after their shares are fitted."""

PILOT_ROUNDS = 4
"""Of `LOOKED_AT_TOGETHER` draws, or of all if those are fewer, after each of which the shares of points are
fitted: those of points that matter are then known to a tenth or two. The mean does not count these draws."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shell:
    """Cells of a grid in an object's box frame that hold its surface.

    Attributes:
        low_m: (3,) corner of the grid.
        edge_m: of a cell.
        held: (X, Y, Z) cells that hold surface.
    """

    low_m: NDArray[np.float64]
    edge_m: float
    held: NDArray[np.bool_]

    @classmethod
    def of(cls, one: SceneObject) -> Shell:
        """As wide as points lie apart: no part of the surface is further from one of them."""
        tree = KDTree(one.points_m)
        reach_m = float(tree.query(one.points_m, k=2)[0][:, 1].max())
        counts = np.ceil(2 * (one.half_extents_m + reach_m) / (reach_m / 2)).astype(int)
        low_m, edge_m = -counts * reach_m / 4, reach_m / 2
        cells = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1)
        held = tree.query(low_m + (cells + 0.5) * edge_m)[0] < reach_m
        return cls(low_m=low_m, edge_m=edge_m, held=held)

    @property
    def volume_m3(self) -> float:
        """Of all cells that hold surface."""
        return float(self.held.sum()) * self.edge_m**3

    def draw(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Points (count, 3), uniform."""
        cells = np.argwhere(self.held)
        return self.low_m + (cells[rng.integers(len(cells), size=count)] + rng.uniform(size=(count, 3))) * (
            self.edge_m
        )

    def holds(self, points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether points (..., 3) lie in it."""
        cells = np.floor((points_m - self.low_m) / self.edge_m).astype(int)
        inside = ((cells >= 0) & (cells < self.held.shape)).all(axis=-1)
        x, y, z = np.moveaxis(np.clip(cells, 0, np.array(self.held.shape) - 1), -1, 0)
        return inside & self.held[x, y, z]


@dataclass(frozen=True, kw_only=True, eq=False)
class PosesThroughPoints:
    """The prior, poses with the prior's rotation that put the object's surface on a point, and kernels.

    A pose that explains two points at once is rare among those through one of them: kernels round heavy draws
    find its like.

    Attributes:
        prior: of poses.
        shell: of the object.
        points_m: (P, 3) in the world.
        shares: (P,) of the draws through points, that go through each.
        kernels: round heavy draws; None before there were any.
    """

    prior: EulerUniformPoses
    shell: Shell
    points_m: NDArray[np.float64]
    shares: NDArray[np.float64]
    kernels: PoseKernels | None = None

    @classmethod
    def even(
        cls, one: SceneObject, prior: EulerUniformPoses, points_m: NDArray[np.float64]
    ) -> PosesThroughPoints | None:
        """Through all points (P, 3) alike that the object can reach; None where there is none."""
        in_cuboid = transform_points(np.linalg.inv(prior.world_from_cuboid), points_m)
        apart_m = np.linalg.norm(in_cuboid - np.clip(in_cuboid, prior.low_m, prior.high_m), axis=1)
        reached = points_m[apart_m < np.linalg.norm(one.half_extents_m)]
        if not len(reached):
            return None
        shares = np.full(len(reached), 1 / len(reached))
        return cls(prior=prior, shell=Shell.of(one), points_m=reached, shares=shares)

    def draw(
        self, rng: np.random.Generator, objects: Sequence[SceneObject], count: int
    ) -> NDArray[np.float64]:
        """Poses (1, count, 4, 4) world_from_box of one object, as of a prior."""
        poses = self.prior.draw(rng, objects, count)[0]
        kind = rng.uniform(size=count)
        near = kind < self._kernel_share
        through = kind > self._kernel_share + PRIOR_SHARE
        points_m = self.points_m[rng.choice(len(self.points_m), int(through.sum()), p=self.shares)]
        in_box_m = self.shell.draw(rng, len(points_m))
        poses[through, :3, 3] = points_m - np.einsum("nij,nj->ni", poses[through, :3, :3], in_box_m)
        if self.kernels:
            poses[near] = self.kernels.draw(rng, int(near.sum()))
        return poses[None]

    def log_weights(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density (n,) of the prior over that of the mixture at poses (n, 4, 4)."""
        log_prior = self.prior.log_density(poses)
        inside = np.isfinite(log_prior)
        ratio = self._passes(poses) @ self.shares * self.prior.volume_m3 / self.shell.volume_m3
        mixture = PRIOR_SHARE + (1 - PRIOR_SHARE - self._kernel_share) * ratio
        if self.kernels:
            log_ratio = self.kernels.log_density(poses) - np.where(inside, log_prior, 0.0)
            mixture += self._kernel_share * np.exp(log_ratio)
        return np.where(inside, -np.log(mixture), -np.inf)

    def fitted(
        self, rng: np.random.Generator, poses: NDArray[np.float64], log_weights: NDArray[np.float64]
    ) -> PosesThroughPoints:
        """With shares in proportion to the weights (n,) of poses (n, 4, 4) through points, and kernels there.

        The poses of kernels are drawn by weight, none twice (population Monte Carlo, Cappe et al. 2004).
        """
        passes = self._passes(poses) * self.shares
        total = passes.sum(axis=1)
        log_weights = np.where(total > 0, log_weights, -np.inf)
        if np.isneginf(log_weights).all():
            return self
        weights = np.exp(log_weights - log_weights.max())
        heavy = np.flatnonzero(weights)
        masses = weights[heavy] @ (passes[heavy] / total[heavy, None])
        even = np.full(len(masses), 1 / len(masses))
        chances = weights[heavy] / weights[heavy].sum()
        chosen = rng.choice(heavy, min(KERNELS, len(heavy)), replace=False, p=chances)
        return replace(
            self,
            shares=LEAST_SHARE * even + (1 - LEAST_SHARE) * masses / masses.sum(),
            kernels=PoseKernels(centres=poses[chosen]),
        )

    @property
    def _kernel_share(self) -> float:
        return KERNEL_SHARE if self.kernels else 0.0

    def _passes(self, poses: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(n, P) whether the object's surface at poses (n, 4, 4) passes through each point."""
        in_box_m = (self.points_m - poses[:, None, :3, 3]) @ poses[:, :3, :3]
        return self.shell.holds(in_box_m)


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawsThroughPoints:
    """One object, from such a mixture; those alone are rendered that a rough look does not rule out.

    Attributes:
        one: the object.
        images: what was seen.
        proposal: from which poses are drawn.
    """

    one: SceneObject
    images: DepthImages
    proposal: PosesThroughPoints
    together: int = LOOKED_AT_TOGETHER

    def draw(self, rng: np.random.Generator, count: int) -> WeighedPoses:
        """As `PoseDraws`."""
        roulette = RouletteDraws(one=self.one, prior=self.proposal, images=self.images)
        poses, log_weights = roulette.draw(rng, count)
        return poses, log_weights + self.proposal.log_weights(poses[0])


def draws_through_points(
    rng: np.random.Generator,
    objects: Sequence[SceneObject],
    prior: PosePrior,
    images: DepthImages,
    draws: int,
) -> PoseDraws:
    """As `pose_draws`; many of one object through unexplained points where there are any."""
    plain = pose_draws(objects, prior, images, draws)
    if not isinstance(plain, RouletteDraws) or not isinstance(prior, EulerUniformPoses):
        return plain
    proposal = PosesThroughPoints.even(plain.one, prior, unexplained_points_m(images))
    return _fitted(rng, plain.one, images, proposal, min(LOOKED_AT_TOGETHER, draws)) if proposal else plain


def unexplained_points_m(images: DepthImages) -> NDArray[np.float64]:
    """Measured points (P, 3) in the world, before what is known, that it does not explain."""
    points = []
    for image in images.images:
        unexplained = np.asarray(_is_unexplained(images.noise, image.observed_m, image.rest_m))
        in_camera_m = unproject(image.observed_m, image.camera)[unexplained]
        points.append(transform_points(np.linalg.inv(image.camera_from_world), in_camera_m))
    return np.concatenate(points)


def _fitted(
    rng: np.random.Generator, one: SceneObject, images: DepthImages, proposal: PosesThroughPoints, draws: int
) -> DrawsThroughPoints:
    """From the proposal fitted to all rounds of so many draws so far, each of which weighs the same."""
    poses, log_weights = np.zeros((0, 4, 4)), np.zeros(0)
    for _ in range(PILOT_ROUNDS):
        drawn, log_drawn = DrawsThroughPoints(one=one, images=images, proposal=proposal).draw(rng, draws)
        poses, log_weights = np.concatenate([poses, drawn[0]]), np.concatenate([log_weights, log_drawn])
        proposal = proposal.fitted(rng, poses, log_weights)
    return DrawsThroughPoints(one=one, images=images, proposal=proposal)


@jax.jit
def _is_unexplained(noise: DepthNoise, observed_m: jax.Array, rest_m: jax.Array) -> jax.Array:
    """(H, W) where a depth was measured before the rest (R, H, W) that is not the sensor's noise of it."""
    of_rest = depth_noise.log_density(noise, observed_m[None], rest_m).max(axis=0)
    of_surface = depth_noise.log_density_of_hit(noise, observed_m, observed_m)
    before = (observed_m > 0) & (observed_m < rest_m.max(axis=0))
    return before & (of_surface - of_rest > UNEXPLAINED_NATS)
