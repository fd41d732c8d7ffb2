"""A lattice of kinds and poses, rendered once for a camera, and the states that a scene gains most by."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from scene.colour.density import FITS_OF_MANY, fit, sums
from scene.colour.rendering import SAMPLES, Layers, render_with_normals
from scene.colour.surroundings import Placed, Surroundings, forbidden
from scene.colour.world import Light, TableWorld

SPACING_M = 0.02
"""Of places: a quarter of the width of a small thing, so that the next state covers most of its pixels."""
YAWS = 12
"""In a full turn: 30 degrees move a mug's handle by less than its length."""
SITES = 3
"""Places at which something is unexplained that are looked at together, ..."""
SITE_M = 0.06
"""... and how far states may stand from the one under which most is: most of a thing's width."""
PIXEL_VARIANCE = 1.5
"""Of the nats that a pixel of three channels lacks, a sum of squares."""
NOISE_SDS = 4.5
"""Of noise, that what is unexplained under a state exceeds at a site: by chance once in 10^5 states."""
EXPLAINS = 0.5
"""Share of the best state's gain from which one explains the site, so that its pixels make no other site."""
WEIGHED = 3
"""States of each kind and yaw at a site whose gain is worked out: those under which most is unexplained."""
OF_EACH_KIND = 3
"""Candidates of each kind at a site: a mug's handle may be taken to be on any side, ..."""
OF_EACH_SITE = 4
"""... of all kinds together: of 117 things of development scenes 115 are among the first three."""
BLUR = 2.0
"""Times the noise with which states are judged, being half a cell off."""
PARTED = 1.5
"""Lattice spacings, of place or of yaw, by which two candidates of one kind differ."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """All states and their renderings.

    Attributes:
        world: in which they stand.
        kinds: (S,).
        poses: (S, 3).
        groups: (G, M) states of each kind and yaw.
        layers: of each state alone.
        normals: (P, 3) of the layers' pixels.
    """

    world: TableWorld
    kinds: NDArray[np.int64]
    poses: NDArray[np.float64]
    groups: NDArray[np.int64]
    layers: Layers
    normals: NDArray[np.float32]

    @cached_property
    def areas(self) -> NDArray[np.float32]:
        """(S,) sums of squares of the shares."""
        return sums(self.layers.start, self.layers.fill**2).astype(np.float32)

    @cached_property
    def fills(self) -> csr_array:
        """(S, H * W) shares of pixels."""
        camera, start = self.world.camera, self.layers.start
        shape = (len(self.kinds), camera.width * camera.height)
        return csr_array((self.layers.fill.astype(np.float32), self.layers.pixel, start), shape)

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
        kinds, poses = [], []
        for number, kind in enumerate(world.kinds):
            turns = max(yaws // kind.turns, 1) if kind.turns else 1
            yaw = np.arange(turns) * (2 * np.pi / turns / max(kind.turns, 1))
            grid = np.stack(np.meshgrid(yaw, place, place, indexing="ij"), axis=-1).reshape(-1, 3)
            kinds.append(np.full(len(grid), number))
            poses.append(grid[:, [1, 2, 0]])
        groups = np.arange(sum(map(len, kinds))).reshape(-1, count**2)
        return cls.rendered(world, np.concatenate(kinds), np.concatenate(poses), groups, 1)

    @classmethod
    def rendered(
        cls,
        world: TableWorld,
        kinds: NDArray[np.int64],
        poses: NDArray[np.float64],
        groups: NDArray[np.int64],
        samples: int = SAMPLES,
    ) -> Lattice:
        """These states."""
        layers, normals = render_with_normals(world, kinds, poses, samples)
        return cls(world, kinds, poses, groups, layers, normals.astype(np.float32))

    def under(self, light: Light) -> Lattice:
        """The same under another lamp."""
        layers = replace(self.layers, shade=light.shade(self.normals))
        return replace(self, world=replace(self.world, light=light), layers=layers)


@dataclass(frozen=True, eq=False)
class Candidates:
    """States that may explain what a scene leaves unexplained.

    Attributes:
        states: (B,) of the lattice.
        sites: (B,) numbers of the places of the image where they do, ascending.
    """

    states: NDArray[np.int64]
    sites: NDArray[np.int64]


def candidates(
    lattice: Lattice, around: Surroundings, sites: int = SITES, each_site: int = OF_EACH_SITE
) -> Candidates:
    """Of the first scene: so many states of the greatest gain at each of some sites."""
    lacking, strange = around.lacking[0].astype(np.float32), around.excess[0].any()
    barred = forbidden(lattice.world, around.scenes[0], lattice.kinds, lattice.poses, SPACING_M / 2)
    found: list[NDArray[np.int64]] = []
    for _ in range(sites):
        promise = np.where(barred, -np.inf, lattice.fills @ lacking)[lattice.groups]
        told = promise > NOISE_SDS * np.sqrt(PIXEL_VARIANCE * lattice.areas[lattice.groups])
        if not told.any() and not (strange and not found):
            break
        states = _promising(lattice, promise)
        if not len(states):
            break
        gain = _gains(lattice, around, states)
        best = _parted(lattice, states, np.argsort(-gain, kind="stable"), each_site)
        if found and gain.max() <= 0:
            break
        found.append(states[best])
        for one in states[gain > EXPLAINS * gain.max()]:
            lacking[lattice.layers.pixel[lattice.layers.start[one] : lattice.layers.start[one + 1]]] = 0.0
    numbers = np.repeat(np.arange(len(found)), [len(one) for one in found])
    return Candidates(np.concatenate([np.zeros(0, np.int64), *found]), numbers)


def _promising(lattice: Lattice, promise: NDArray[np.floating]) -> NDArray[np.int64]:
    """States near the one under which most is unexplained, some of each kind and yaw; promise (G, M)."""
    places = lattice.poses[lattice.groups[0], :2]
    apart = np.linalg.norm(places - places[promise.max(axis=0).argmax()], axis=1)
    near = np.flatnonzero(apart < SITE_M)
    count = min(WEIGHED, len(near))
    best = near[np.argpartition(-promise[:, near], count - 1, axis=1)[:, :count]]
    states = np.take_along_axis(lattice.groups, best, axis=1).ravel()
    return states[np.isfinite(np.take_along_axis(promise, best, axis=1).ravel())]


def _gains(lattice: Lattice, around: Surroundings, states: NDArray[np.int64]) -> NDArray[np.float64]:
    """Of states (B,)."""
    world, noise = lattice.world, lattice.world.noise.blurred(BLUR)
    placed = Placed.of(world, around, lattice.layers.of(states), np.zeros(len(states), np.int64), rough=True)
    return placed.gains(noise, fit(placed.segments, noise, steps=FITS_OF_MANY))


def _parted(lattice: Lattice, states: NDArray[np.int64], ranked: NDArray[np.int64], wanted: int) -> list[int]:
    """The first few of the ranked that are apart from each other, few of each kind."""
    parted: list[int] = []
    count = np.zeros(len(lattice.world.kinds), np.int64)
    for one in ranked.tolist():
        state = int(states[one])
        kind = lattice.kinds[state]
        alike = [other for other in parted if lattice.kinds[states[other]] == kind]
        if count[kind] < OF_EACH_KIND and lattice.apart(states[alike], state).all():
            parted.append(one)
            count[kind] += 1
        if len(parted) == wanted:
            break
    return parted
