"""Posterior density of a scene given one colour image, against the empty table; exact.

log p(image, scene) - log p(image | empty table) = log p(scene) + sum over things of
[log evidence of its pixels, albedo integrated out - log density of these pixels as table].

A pixel belongs to the thing that fills most of it. Of the colours of other things in it their prior alone is
known, so that things part: a pixel at the outline between two of them tells less than one on the table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from scene.colour.density import Segments, albedo_evidence, factor_prior, log_density
from scene.colour.rendering import Layers, Neighbours, render
from scene.colour.world import TableWorld

OVERLAP_M = 0.002
"""By more than this no two boxes overlap."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Things on the table.

    Attributes:
        kinds: (N,) numbers of kinds.
        poses: (N, 3) x, y in metres and yaw in radians.
    """

    kinds: NDArray[np.int64]
    poses: NDArray[np.float64]

    @classmethod
    def empty(cls) -> Scene:
        """The table alone."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3)))

    def __len__(self) -> int:
        return len(self.kinds)

    def without(self, *things: int) -> Scene:
        """The others."""
        return Scene(np.delete(self.kinds, things), np.delete(self.poses, things, axis=0))

    def joined(self, kinds: NDArray[np.int64], poses: NDArray[np.float64]) -> Scene:
        """With more things (B,) at poses (B, 3)."""
        return Scene(np.concatenate([self.kinds, kinds]), np.concatenate([self.poses, poses]))

    @property
    def kinds_there(self) -> tuple[int, ...]:
        """Numbers of the kinds, ascending: scenes of the same things have the same."""
        return tuple(sorted(self.kinds.tolist()))


@dataclass(frozen=True, eq=False)
class ColourImage:
    """An image and its density as the table alone.

    Attributes:
        colour: (H * W, C) in 0..1; +inf or -inf where it was clipped.
        table_colour: (C,) of the empty table.
        table: (H * W,) log density of each pixel as table.
    """

    colour: NDArray[np.float64]
    table_colour: NDArray[np.float64]
    table: NDArray[np.float64]


def colour_image(
    world: TableWorld, image: NDArray[np.floating], table_colour: NDArray[np.floating] | None = None
) -> ColourImage:
    """An image (H, W, C) in 0..1 as the posterior wants it; a table of unknown colour has the median's.

    Raises:
        ValueError: the image is not of the camera's size.
    """
    if image.shape[:2] != (world.camera.height, world.camera.width):
        raise ValueError(
            f"the image is {image.shape[1]}x{image.shape[0]}, the camera "
            f"{world.camera.width}x{world.camera.height}"
        )
    colour = np.asarray(image, np.float64).reshape(world.camera.width * world.camera.height, -1)
    bounded = np.nan_to_num(colour, posinf=1.0, neginf=0.0)
    table = np.median(bounded, axis=0) if table_colour is None else np.asarray(table_colour, np.float64)
    return ColourImage(colour, table, log_density(colour, table, world.noise).sum(axis=1))


def log_prior(world: TableWorld, scene: Scene) -> float:
    """Log density of an unordered scene in (x, y, yaw) of each thing; of a round thing in (x, y) alone.

    -inf where things leave the square or overlap; up to the constant by which the overlap rule lessens the
    mass of each number of things.
    """
    if len(scene) > world.most or (np.abs(scene.poses[:, :2]) > world.half_m).any():
        return -np.inf
    if overlapping(world, scene).any():
        return -np.inf
    each = -np.log(len(world.kinds)) - 2 * np.log(2 * world.half_m)
    spins = (~world.spins[scene.kinds]).sum() * np.log(2 * np.pi)
    return float(len(scene) * each - spins + gammaln(len(scene) + 1) - np.log(world.most + 1))


@dataclass(frozen=True, eq=False)
class View:
    """Things seen together, one before the other.

    Attributes:
        layers: of the things.
        place: (P,) of the layers' pixels, counted through all scenes.
        share: (P,) of the pixel that shows the thing.
        table: (P,) of the pixel that shows the table.
        leads: (P,) whether no other thing is seen in more of the pixel.
    """

    layers: Layers
    place: NDArray[np.int64]
    share: NDArray[np.float64]
    table: NDArray[np.float64]
    leads: NDArray[np.bool_]


def seen_together(world: TableWorld, layers: Layers, scenes: NDArray[np.int64] | None = None) -> View:
    """Of things that are all there, or in these scenes (B,): nearer ones hide as much as they fill."""
    place = layers.pixel
    if scenes is not None:
        place = place + world.camera.width * world.camera.height * np.repeat(scenes, np.diff(layers.start))
    order = np.lexsort((layers.depth_m, place))
    fill, at = layers.fill[order], place[order]
    rank = _ranks(at)
    free = np.ones(len(fill))
    for one in range(1, rank.max(initial=0) + 1):
        behind = np.flatnonzero(rank == one)
        free[behind] = free[behind - 1] * (1 - fill[behind - 1])
    first = np.flatnonzero(rank == 0)
    count = np.diff(np.append(first, len(fill)))
    left = np.repeat((free * (1 - fill))[first + count - 1], count)
    most = np.repeat(np.maximum.reduceat(free * fill, first), count) if len(first) else free
    back = np.empty(len(order), np.int64)
    back[order] = np.arange(len(order))
    return View(layers, place, (free * fill)[back], left[back], (free * fill >= most)[back])


def rendered_together(world: TableWorld, scenes: Sequence[Scene]) -> tuple[Layers, NDArray[np.int64]]:
    """The things (B,) of some scenes, each alone, one scene after another; and the scene (B,) of each."""
    every = [Scene.empty(), *scenes]
    kinds, poses = np.concatenate([one.kinds for one in every]), np.concatenate([one.poses for one in every])
    return render(world, kinds, poses), np.repeat(np.arange(len(scenes)), list(map(len, scenes)))


def segments_of(world: TableWorld, image: ColourImage, view: View) -> Segments:
    """The pixels that each thing leads in, with what is known of its colours."""
    layers, leads = view.layers, view.leads
    lit = layers.lit(image.colour.shape[1])
    base, variance = view.table[:, None] * image.table_colour, None
    if not leads.all():
        mean, sd = factor_prior(world.is_coloured[layers.kinds][layers.owner, None], world.noise)
        own = np.broadcast_to(view.share[:, None] * lit, base.shape)
        base = base + _others(view.place, own * mean)
        variance = np.maximum(_others(view.place, (own * sd) ** 2), 0.0)[leads]
    start = np.concatenate([[0], np.cumsum(leads)])[layers.start]
    return Segments(
        start=start,
        colour=image.colour[layers.pixel[leads]],
        lit=lit[leads],
        is_known=world.is_coloured[layers.kinds],
        share=view.share[leads, None],
        base=base[leads],
        variance=variance,
        unresolved=Neighbours.of(layers, world.camera).unresolved(lit)[leads],
    )


def log_likelihood(world: TableWorld, image: ColourImage, scene: Scene) -> float:
    """Log density of the image given the scene less that given the empty table."""
    layers = render(world, scene.kinds, scene.poses)
    return float(visible_gain(world, image, seen_together(world, layers)).sum())


def visible_gain(world: TableWorld, image: ColourImage, view: View) -> NDArray[np.float64]:
    """Log evidence (B,) of the pixels of each thing against the table."""
    segments = segments_of(world, image, view)
    table = np.concatenate([[0], np.cumsum(image.table[view.layers.pixel[view.leads]])])
    evidence = albedo_evidence(segments, world.noise)
    return np.where(np.diff(segments.start) > 0, evidence, 0.0) - np.diff(table[segments.start])


def log_posterior(world: TableWorld, image: ColourImage, scene: Scene) -> float:
    """`log_prior` plus `log_likelihood`."""
    prior = log_prior(world, scene)
    return prior + log_likelihood(world, image, scene) if np.isfinite(prior) else prior


def overlapping(world: TableWorld, scene: Scene) -> NDArray[np.bool_]:
    """Which pairs (N, N) of different things overlap by more than `OVERLAP_M`."""
    poses = np.repeat(scene.poses[:, None], len(scene), axis=1)
    kinds = np.repeat(scene.kinds[:, None], len(scene), axis=1)
    depths, _ = overlap_depths(world, kinds, poses, kinds.T, poses.swapaxes(0, 1))
    return (depths > OVERLAP_M) & ~np.eye(len(scene), dtype=np.bool_)


def overlap_depths(
    world: TableWorld,
    kinds: NDArray[np.int64],
    poses: NDArray[np.float64],
    other_kinds: NDArray[np.int64],
    other_poses: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How far (...) boxes overlap others, -inf of far ones, and the way (..., 2) that parts them soonest.

    Separating axes of two rectangles (Gottschalk, Lin and Manocha 1996); a round thing's box has yaw 0.
    """
    reach = world.reaches_m[kinds] + world.reaches_m[other_kinds]
    near = ((poses[..., :2] - other_poses[..., :2]) ** 2).sum(axis=-1) < reach**2
    depths, ways = np.full(near.shape, -np.inf), np.zeros((*near.shape, 2))
    if near.any():
        ends = (kinds[near], poses[near]), (other_kinds[near], other_poses[near])
        depths[near], ways[near] = _depths_of_near(world, *ends)
    return depths, ways


def _depths_of_near(
    world: TableWorld, *pairs: tuple[NDArray[np.int64], NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`overlap_depths` (B,) and (B, 2) of kinds and poses."""
    (kinds, _), (other_kinds, _) = pairs
    halves = np.array([kind.half_m for kind in world.kinds])
    middles = np.array([kind.middle_m for kind in world.kinds])
    turns = [np.where(world.spins[kind], 0.0, pose[..., 2]) for kind, pose in pairs]
    half = [halves[kinds], halves[other_kinds]]
    ends = [
        pose[..., :2] + _rotated(middles[kind], turn) for (kind, pose), turn in zip(pairs, turns, strict=True)
    ]
    apart = ends[0] - ends[1]
    least, way = np.full(kinds.shape, np.inf), np.zeros((*kinds.shape, 2))
    for turn in turns:
        for quarter in (0.0, np.pi / 2):
            axis = np.stack([np.cos(turn + quarter), np.sin(turn + quarter)], axis=-1)
            reach = sum(
                np.abs(np.cos(turn + quarter - own)) * size[..., 0]
                + np.abs(np.sin(turn + quarter - own)) * size[..., 1]
                for own, size in zip(turns, half, strict=True)
            )
            distance = (axis * apart).sum(axis=-1)
            depth = reach - np.abs(distance)
            way = np.where((depth < least)[..., None], axis * np.sign(distance)[..., None], way)
            least = np.minimum(least, depth)
    return least, way


def _rotated(points: NDArray[np.float64], turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (..., 2) turned by angles (...)."""
    cosine, sine = np.cos(turn), np.sin(turn)
    x, y = points[..., 0], points[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def _others(place: NDArray[np.int64], own: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums (P, C) of what other things add to the same places."""
    number = np.unique(place, return_inverse=True)[1]
    total = [np.bincount(number, channel) for channel in own.T]
    return np.stack(total, axis=1)[number] - own


def _ranks(sorted_places: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many equal ones stand before each."""
    number = np.arange(len(sorted_places))
    first = np.append(True, sorted_places[1:] != sorted_places[:-1])[: len(number)]
    return number - np.maximum.accumulate(np.where(first, number, 0))
