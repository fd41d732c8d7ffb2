"""A lattice of kinds and poses, rendered once for a camera, and the gain of adding each state to a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.colour.density import Segments, laplace_evidence, log_density
from scene.colour.posterior import ColourImage, Scene, boxes_overlap, visible
from scene.colour.world import Layers, TableWorld, render

SPACING_M = 0.02
"""Of places: a quarter of the width of a small thing, so that the next state covers most of its pixels."""
YAWS = 12
"""In a full turn: 30 degrees move a mug's handle by less than its length."""
WEIGHED = 24
"""States of each kind and yaw whose gain is worked out: those under which most is unexplained."""
TURNED_M = 0.021
"""Round a pose, in which states of other yaws are looked at: the places next to it."""
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
    """

    kinds: NDArray[np.int64]
    poses: NDArray[np.float64]
    groups: NDArray[np.int64]
    layers: Layers

    def apart(self, one: int, other: int) -> bool:
        """Whether two states differ by more than neighbours do, in place or in yaw."""
        shift = np.abs(self.poses[one] - self.poses[other])
        turn = min(shift[2], 2 * np.pi - shift[2])
        return bool(shift[:2].max() > PARTED * SPACING_M or turn > PARTED * 2 * np.pi / YAWS)

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
        states = np.concatenate(kinds), np.concatenate(poses)
        return cls(*states, np.concatenate(groups), render(world, *states))


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
        segments = Segments(seen.start, image.colour[seen.pixel], seen.shade)
        _, albedo = laplace_evidence(segments, world.noise)
        rendered = seen.shade[:, None] * albedo[segments.owner]
        depth[seen.pixel] = seen.depth_m
        explained[seen.pixel] = log_density(segments.colour, rendered, world.noise).sum(axis=1)
    return Surroundings(scene, depth, explained)


def gains(world: TableWorld, image: ColourImage, rest: Surroundings, layers: Layers) -> NDArray[np.float64]:
    """Log evidence (B,) that each thing alone would add: of the pixels where it is seen, less as explained.

    Laplace's evidence, the albedos of the rest held: for searching.
    """
    seen = layers.kept(layers.depth_m < rest.depth_m[layers.pixel])
    segments = Segments(seen.start, image.colour[seen.pixel], seen.shade)
    evidence, _ = laplace_evidence(segments, world.noise)
    return evidence - _sums_of(rest.explained, seen)


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
    """States by gain, so many of each kind, apart from each other; only those that may stand there."""
    need = image.colour.shape[1] * np.log(1 / (world.noise.sigma * np.sqrt(2 * np.pi)))
    unexplained = Surroundings(rest.scene, rest.depth_m, rest.explained - need)
    layers = lattice.layers.kept(lattice.layers.depth_m < rest.depth_m[lattice.layers.pixel])
    promise = -_sums_of(unexplained.explained, layers)
    promise[_overlap_rest(world, rest, lattice.kinds, lattice.poses)] = -np.inf
    weighed = np.concatenate(
        [
            (mine := np.flatnonzero(lattice.groups == group))[np.argsort(-promise[mine])[:WEIGHED]]
            for group in range(lattice.groups.max() + 1)
        ]
    )
    weighed = weighed[np.isfinite(promise[weighed])]
    gain = gains(world, image, rest, lattice.layers.of(weighed))
    chosen: list[int] = []
    for state in weighed[np.argsort(-gain)].tolist():
        rivals = [one for one in chosen if lattice.kinds[one] == lattice.kinds[state]]
        if len(rivals) < of_each_kind and all(lattice.apart(one, state) for one in rivals):
            chosen.append(state)
    return np.array(chosen, np.int64)


def turned(
    world: TableWorld, image: ColourImage, rest: Surroundings, lattice: Lattice, kind: int, pose: NDArray
) -> NDArray[np.int64]:
    """The states of one kind near a pose with the greatest gain for each yaw, the better ones first."""
    near = np.abs(lattice.poses[:, :2] - pose[:2]).max(axis=1) <= TURNED_M
    states = np.flatnonzero(near & (lattice.kinds == kind))
    states = states[~_overlap_rest(world, rest, lattice.kinds[states], lattice.poses[states])]
    ordered = states[np.argsort(-gains(world, image, rest, lattice.layers.of(states)))]
    _, first = np.unique(lattice.groups[ordered], return_index=True)
    return ordered[np.sort(first)]


def _overlap_rest(
    world: TableWorld, rest: Surroundings, kinds: NDArray[np.int64], poses: NDArray[np.float64]
) -> NDArray[np.bool_]:
    overlap = np.zeros(len(kinds), np.bool_)
    for kind, pose in zip(rest.scene.kinds, rest.scene.poses, strict=True):
        others = np.full(len(kinds), kind), np.broadcast_to(pose, poses.shape)
        overlap |= boxes_overlap(world, kinds, poses, *others)
    return overlap


def _sums_of(values: NDArray[np.float64], layers: Layers) -> NDArray[np.float64]:
    """Sums (B,) over each thing's pixels."""
    return np.diff(np.concatenate([[0], np.cumsum(values[layers.pixel])])[layers.start])
