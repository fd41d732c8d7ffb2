"""A lattice of kinds and poses, rendered once for a camera, and the gain of adding each state to a scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scene.colour.density import laplace_evidence, log_density
from scene.colour.kernels import log_gains
from scene.colour.posterior import ColourImage, Scene, boxes_overlap, segments_of, visible
from scene.colour.world import Layers, Light, TableWorld, render, render_with_normals

SPACING_M = 0.02
"""Of places: a quarter of the width of a small thing, so that the next state covers most of its pixels."""
YAWS = 12
"""In a full turn: 30 degrees move a mug's handle by less than its length."""
WEIGHED = 16
"""States of each kind and yaw whose gain is worked out: those under which most is unexplained."""
PARTED = 1.5
"""Lattice spacings, of place or of yaw, by which two candidates of one kind differ."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """All states and their renderings.

    Attributes:
        kinds: (S,).
        poses: (S, 3).
        groups: (S,) numbers of kind and yaw together.
        layers: of each state alone.
        normals: (P, 3) of the layers' pixels.
    """

    kinds: NDArray[np.int64]
    poses: NDArray[np.float64]
    groups: NDArray[np.int64]
    layers: Layers
    normals: NDArray[np.float32]

    @cached_property
    def members(self) -> list[NDArray[np.int64]]:
        """States of each group."""
        return [np.flatnonzero(self.groups == group) for group in range(self.groups.max() + 1)]

    def apart(self, states: NDArray[np.int64], other: int) -> NDArray[np.bool_]:
        """Whether states differ from one by more than neighbours do, in place or in yaw."""
        shift = np.abs(self.poses[states] - self.poses[other])
        turn = np.minimum(shift[:, 2], 2 * np.pi - shift[:, 2])
        return (shift[:, :2].max(axis=1) > PARTED * SPACING_M) | (turn > PARTED * 2 * np.pi / YAWS)

    @classmethod
    def of(cls, world: TableWorld, spacing_m: float = SPACING_M, yaws: int = YAWS) -> Lattice:
        """Cells of about these sizes over the square and over the turn that tells a kind's yaws apart."""
        count = max(round(2 * world.half_m / spacing_m), 1)
        place = (np.arange(count) + 0.5) * (2 * world.half_m / count) - world.half_m
        kinds, poses, groups = [], [], []
        for number, kind in enumerate(world.kinds):
            turns = max(yaws // kind.turns, 1) if kind.turns else 1
            yaw = np.arange(turns) * (2 * np.pi / turns / max(kind.turns, 1))
            grid = np.stack(np.meshgrid(place, place, yaw, indexing="ij"), axis=-1).reshape(-1, 3)
            groups.append(sum(len(np.unique(one)) for one in groups) + np.tile(np.arange(turns), count**2))
            kinds.append(np.full(len(grid), number))
            poses.append(grid)
        return cls.rendered(world, np.concatenate(kinds), np.concatenate(poses), np.concatenate(groups))

    @classmethod
    def rendered(
        cls,
        world: TableWorld,
        kinds: NDArray[np.int64],
        poses: NDArray[np.float64],
        groups: NDArray[np.int64],
    ) -> Lattice:
        """These states."""
        layers, normals = render_with_normals(world, kinds, poses)
        return cls(kinds, poses, groups, layers, normals.astype(np.float32))

    def under(self, light: Light) -> Lattice:
        """The same under another lamp."""
        return replace(self, layers=replace(self.layers, shade=light.shade(self.normals)))


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What stands beside a thing that is to be placed: the rest of a scene.

    Attributes:
        scene: the rest.
        depth_m: (H * W,) nearest, +inf over the table.
        explained: (H * W,) log density of each pixel as the rest explains it, albedos at their best.
    """

    scene: Scene
    depth_m: NDArray[np.float64]
    explained: NDArray[np.float64]


def surroundings(world: TableWorld, image: ColourImage, scene: Scene) -> Surroundings:
    """Of a thing to be added to a scene."""
    depth, explained = np.full(len(image.table), np.inf), image.table.copy()
    if len(scene):
        seen = visible(world, render(world, scene.kinds, scene.poses))
        segments = segments_of(world, image, seen)
        _, albedo = laplace_evidence(segments, world.noise)
        rendered = segments.lit * albedo[segments.owner]
        depth[seen.pixel] = seen.depth_m
        explained[seen.pixel] = log_density(segments.colour, rendered, world.noise).sum(axis=1)
    return Surroundings(scene, depth, explained)


def gains(world: TableWorld, image: ColourImage, rest: Surroundings, layers: Layers) -> NDArray[np.float64]:
    """Log evidence (B,) that each thing alone would add: of the pixels where it is seen, less as explained.

    Laplace's evidence, the albedos of the rest held: for searching.
    """
    return log_gains(world, image.colour, rest.explained, rest.depth_m, layers)


def placed_gains(
    world: TableWorld,
    image: ColourImage,
    rest: Surroundings,
    kinds: NDArray[np.int64],
    poses: NDArray[np.float64],
) -> NDArray[np.float64]:
    """`gains` of things (B,) at poses (B, 3); -inf off the square or where boxes overlap."""
    value = gains(world, image, rest, render(world, kinds, poses))
    outside = (np.abs(poses[:, :2]) > world.half_m).any(axis=1)
    return np.where(outside | _overlap_rest(world, rest, kinds, poses), -np.inf, value)


def candidates(
    world: TableWorld, image: ColourImage, rest: Surroundings, lattice: Lattice, of_each_kind: int
) -> NDArray[np.int64]:
    """States of the greatest gain, so many of each kind, apart from each other, where they may stand."""
    need = image.colour.shape[1] * np.log(1 / (world.noise.sigma * np.sqrt(2 * np.pi)))
    layers = lattice.layers
    unexplained = (need - rest.explained)[layers.pixel]
    if len(rest.scene):
        unexplained *= layers.depth_m < rest.depth_m[layers.pixel]
    promise = np.diff(np.concatenate([[0], np.cumsum(unexplained)])[layers.start])
    promise[_overlap_rest(world, rest, lattice.kinds, lattice.poses)] = -np.inf
    weighed = np.concatenate([mine[np.argsort(-promise[mine])[:WEIGHED]] for mine in lattice.members])
    weighed = weighed[np.isfinite(promise[weighed])]
    weighed = weighed[np.argsort(-gains(world, image, rest, lattice.layers.of(weighed)))]
    chosen: list[int] = []
    for kind in range(len(world.kinds)):
        left = weighed[lattice.kinds[weighed] == kind]
        for _ in range(min(of_each_kind, len(left))):
            if len(left):
                chosen.append(int(left[0]))
                left = left[lattice.apart(left, chosen[-1])]
    return np.array(chosen, np.int64)


def _overlap_rest(
    world: TableWorld, rest: Surroundings, kinds: NDArray[np.int64], poses: NDArray[np.float64]
) -> NDArray[np.bool_]:
    overlap = np.zeros(len(kinds), np.bool_)
    for kind, pose in zip(rest.scene.kinds, rest.scene.poses, strict=True):
        others = np.full(len(kinds), kind), np.broadcast_to(pose, poses.shape)
        overlap |= boxes_overlap(world, kinds, poses, *others)
    return overlap
