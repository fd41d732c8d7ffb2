"""Posterior density of a scene given one colour image, against the empty table; exact.

log p(image, scene) - log p(image | empty table) = log p(scene) + sum over things of
[log evidence of its visible pixels, albedo integrated out - log density of these pixels as table].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from scene.colour.density import Segments, albedo_evidence, log_density
from scene.colour.world import Layers, TableWorld, render

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

    def joined(self, kind: int, pose: NDArray[np.float64]) -> Scene:
        """With one more."""
        return Scene(np.append(self.kinds, kind), np.concatenate([self.poses, pose[None]]))


@dataclass(frozen=True, eq=False)
class ColourImage:
    """An image and its density as the table alone.

    Attributes:
        colour: (H * W, C) in 0..1; +inf or -inf where it was clipped.
        table: (H * W,) log density of each pixel as table.
    """

    colour: NDArray[np.float64]
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
    table = np.median(bounded, axis=0) if table_colour is None else np.asarray(table_colour)
    return ColourImage(colour, log_density(colour, table, world.noise).sum(axis=1))


def log_prior(world: TableWorld, scene: Scene) -> float:
    """Log density of an unordered scene in (x, y, yaw) of each thing; of a round thing in (x, y) alone.

    -inf where things leave the square or overlap; up to the constant by which the overlap rule lessens the
    mass of each number of things.
    """
    if len(scene) > world.most or (np.abs(scene.poses[:, :2]) > world.half_m).any():
        return -np.inf
    if overlapping(world, scene).any():
        return -np.inf
    round_ones = np.array([world.kinds[kind].turns == 0 for kind in scene.kinds], np.bool_)
    each = -np.log(len(world.kinds)) - 2 * np.log(2 * world.half_m)
    spins = (~round_ones).sum() * np.log(2 * np.pi)
    return float(len(scene) * each - spins + gammaln(len(scene) + 1) - np.log(world.most + 1))


def log_likelihood(world: TableWorld, image: ColourImage, scene: Scene) -> float:
    """Log density of the image given the scene less that given the empty table."""
    layers = render(world, scene.kinds, scene.poses)
    return float(visible_gain(world, image, visible(world, layers)).sum())


def visible(world: TableWorld, layers: Layers, scenes: NDArray[np.int64] | None = None) -> Layers:
    """Of things that are all there, or in these scenes (B,), what the nearer ones leave to be seen."""
    pixels = world.camera.width * world.camera.height
    place, count = layers.pixel, 1
    if scenes is not None:
        place, count = place + pixels * np.repeat(scenes, np.diff(layers.start)), scenes.max(initial=0) + 1
    nearest = np.full(pixels * count, np.inf)
    np.minimum.at(nearest, place, layers.depth_m)
    return layers.kept(layers.depth_m <= nearest[place])


def segments_of(world: TableWorld, image: ColourImage, seen: Layers) -> Segments:
    """The pixels that show each thing, with what is known of its colours."""
    colours = world.face_colours(image.colour.shape[1])
    lit = seen.shade[:, None] * colours[seen.face]
    return Segments(seen.start, image.colour[seen.pixel], lit, world.is_coloured[seen.kinds])


def visible_gain(world: TableWorld, image: ColourImage, seen: Layers) -> NDArray[np.float64]:
    """Log evidence (B,) of the pixels of each thing against the table."""
    segments = segments_of(world, image, seen)
    table = np.concatenate([[0], np.cumsum(image.table[seen.pixel])])
    evidence = albedo_evidence(segments, world.noise)
    return np.where(np.diff(seen.start) > 0, evidence, 0.0) - np.diff(table[seen.start])


def log_posterior(world: TableWorld, image: ColourImage, scene: Scene) -> float:
    """`log_prior` plus `log_likelihood`."""
    prior = log_prior(world, scene)
    return prior + log_likelihood(world, image, scene) if np.isfinite(prior) else prior


def overlapping(world: TableWorld, scene: Scene) -> NDArray[np.bool_]:
    """Which pairs (N, N) of different things overlap by more than `OVERLAP_M`."""
    poses = np.repeat(scene.poses[:, None], len(scene), axis=1)
    kinds = np.repeat(scene.kinds[:, None], len(scene), axis=1)
    both = boxes_overlap(world, kinds, poses, kinds.T, poses.swapaxes(0, 1))
    return both & ~np.eye(len(scene), dtype=np.bool_)


def boxes_overlap(
    world: TableWorld,
    kinds: NDArray[np.int64],
    poses: NDArray[np.float64],
    other_kinds: NDArray[np.int64],
    other_poses: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Whether boxes (...) overlap others (...) by more than `OVERLAP_M` along each axis that could part them.

    Separating axes of two rectangles (Gottschalk, Lin and Manocha 1996); a round thing's box has yaw 0.
    """
    halves = np.array([kind.half_m for kind in world.kinds])
    middles = np.array([kind.middle_m for kind in world.kinds])
    is_round = np.array([kind.turns == 0 for kind in world.kinds])
    turns = [np.where(is_round[k], 0.0, p[..., 2]) for k, p in ((kinds, poses), (other_kinds, other_poses))]
    half = [halves[kinds], halves[other_kinds]]
    ends = [
        place[..., :2] + _rotated(middles[kind], turn)
        for kind, place, turn in zip((kinds, other_kinds), (poses, other_poses), turns, strict=True)
    ]
    apart = ends[1] - ends[0]
    least = np.full(kinds.shape, np.inf)
    for turn in turns:
        for quarter in (0.0, np.pi / 2):
            axis = turn + quarter
            reach = sum(
                np.abs(np.cos(axis - own)) * size[..., 0] + np.abs(np.sin(axis - own)) * size[..., 1]
                for own, size in zip(turns, half, strict=True)
            )
            distance = np.abs(np.cos(axis) * apart[..., 0] + np.sin(axis) * apart[..., 1])
            least = np.minimum(least, reach - distance)
    return least > OVERLAP_M


def _rotated(points: NDArray[np.float64], turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (..., 2) turned by angles (...)."""
    cosine, sine = np.cos(turn), np.sin(turn)
    x, y = points[..., 0], points[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
