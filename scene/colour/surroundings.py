"""What stands beside a thing that is to be placed, and what the thing would add to the log evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from scene.colour.density import ColourNoise, Fit, Segments, fit, laplace_evidence, log_density, sums
from scene.colour.posterior import (
    OVERLAP_M,
    ColourImage,
    Scene,
    overlap_depths,
    rendered_together,
    seen_together,
    segments_of,
)
from scene.colour.rendering import Layers, Neighbours
from scene.colour.world import TableWorld

ALMOST = 0.9
"""Share of the overlap that is allowed to which things are moved apart."""
TOGETHER_PX = 3
"""Pixels along each side of a block ..."""
STRANGE_NATS = 20.0
"""... that is less probable than it should be by so much: five deviations of three channels' noise."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Scenes that lack a thing, albedos at their best, on one image: one image of each, end to end.

    Attributes:
        scenes: what stands there already.
        image: that is looked at.
        pixels: as they are explained.
        lacking: (S, H * W) nats by which pixels are less probable than their noise makes them on the average.
        excess: (S, H * W) the same where more is lacking together than by noise; else 0.
    """

    scenes: Sequence[Scene]
    image: ColourImage
    pixels: Explained
    lacking: NDArray[np.float64]
    excess: NDArray[np.float64]

    @classmethod
    def of(cls, world: TableWorld, image: ColourImage, scenes: Sequence[Scene]) -> Surroundings:
        """Of a thing to be added to any of some scenes."""
        explained = Explained.empty(world, image, len(scenes))
        if any(map(len, scenes)):
            explained.fill_in(world, image, *rendered_together(world, scenes))
        lacking = explained.expected - explained.log_density
        lacking = lacking.reshape(len(scenes), world.camera.height, world.camera.width)
        together = TOGETHER_PX**2 * uniform_filter(lacking, TOGETHER_PX, axes=(1, 2), mode="constant")
        return cls(
            scenes=scenes,
            image=image,
            pixels=explained,
            lacking=lacking.reshape(len(scenes), -1),
            excess=np.where(together > STRANGE_NATS, lacking, 0.0).reshape(len(scenes), -1),
        )


@dataclass(eq=False)
class Explained:
    """Pixels of all scenes in turn, as they are rendered.

    Attributes:
        rendered: (S * H * W, C).
        front: (S * H * W, C) what the nearest thing adds to it.
        fill: (S * H * W,) share that the nearest thing fills.
        depth_m: (S * H * W,) its depth.
        log_density: (S * H * W,).
        expected: (S * H * W,) mean of the log density, outliers left out.
    """

    rendered: NDArray[np.float64]
    front: NDArray[np.float64]
    fill: NDArray[np.float64]
    depth_m: NDArray[np.float64]
    log_density: NDArray[np.float64]
    expected: NDArray[np.float64]

    @classmethod
    def empty(cls, world: TableWorld, image: ColourImage, scenes: int) -> Explained:
        """Tables."""
        pixels, channels = image.colour.shape
        count = scenes * pixels
        return cls(
            rendered=np.tile(image.table_colour, (count, 1)),
            front=np.zeros((count, channels)),
            fill=np.zeros(count),
            depth_m=np.full(count, np.inf),
            log_density=np.tile(image.table, scenes),
            expected=np.full(count, channels * float(_expected(np.array(world.noise.sigma), world.noise))),
        )

    def fill_in(
        self, world: TableWorld, image: ColourImage, layers: Layers, scenes: NDArray[np.int64]
    ) -> None:
        """Things (B,) that stand in these scenes (B,)."""
        view = seen_together(world, layers, scenes)
        segments = segments_of(world, image, view)
        albedo = fit(segments, world.noise).factor
        own = view.share[:, None] * layers.lit(image.colour.shape[1]) * albedo[layers.owner]
        self.rendered[view.place] = view.table[:, None] * image.table_colour
        np.add.at(self.rendered, view.place, own)
        order = np.argsort(-layers.depth_m, kind="stable")  # the nearest is written last
        place = view.place[order]
        self.depth_m[place], self.fill[place] = layers.depth_m[order], layers.fill[order]
        self.front[place] = own[order]
        place, own = view.place[view.leads], own[view.leads]
        known = replace(segments, base=self.rendered[place] - own, variance=None)
        spread = np.sqrt(known.variances(albedo[segments.owner], world.noise))
        density = log_density(segments.colour, self.rendered[place], world.noise, spread)
        self.log_density[place] = density.sum(axis=1)
        self.expected[place] = _expected(spread, world.noise).sum(axis=1)


def pushed_out(
    world: TableWorld, rest: Scene, kinds: NDArray[np.int64], poses: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Poses (B, 3) of things moved out of the rest, the shortest way, as far as the overlap rule wants it."""
    poses = poses.copy()
    for kind, pose in zip(rest.kinds, rest.poses, strict=True):
        others = np.full(len(kinds), kind), np.broadcast_to(pose, poses.shape)
        depth, way = overlap_depths(world, kinds, poses, *others)
        poses[:, :2] += way * np.maximum(depth - ALMOST * OVERLAP_M, 0.0)[:, None]
    poses[:, :2] = np.clip(poses[:, :2], -world.half_m, world.half_m)
    return poses


def parted(world: TableWorld, scene: Scene) -> Scene:
    """Each thing moved out of those before it."""
    poses = scene.poses.copy()
    for one in range(1, len(scene)):
        before, mine = Scene(scene.kinds[:one], poses[:one]), slice(one, one + 1)
        poses[mine] = pushed_out(world, before, scene.kinds[mine], poses[mine])
    return Scene(scene.kinds, poses)


def _expected(spread: NDArray[np.float64], noise: ColourNoise) -> NDArray[np.float64]:
    return np.log((1 - noise.outlier) / (spread * np.sqrt(2 * np.pi))) - 0.5


@dataclass(frozen=True, eq=False)
class Placed:
    """Pixels of things (B,) put into their surroundings, the albedos of the rest held: for searching.

    Attributes:
        segments: of the things.
        explained: (P,) log density of the pixels without them.
        free: (P, 1) share of the pixel that nothing nearer fills.
        behind: (P, C) colour that a thing hides.
    """

    segments: Segments
    explained: NDArray[np.float64]
    free: NDArray[np.float64]
    behind: NDArray[np.float64]

    @classmethod
    def of(
        cls, world: TableWorld, around: Surroundings, layers: Layers, images: NDArray[np.int64], rough: bool
    ) -> Placed:
        """Things in these images (B,); `rough` takes outlines and edges as they are rendered."""
        colour, pixels = around.image.colour, around.pixels
        place = layers.pixel + len(colour) * images[layers.owner]
        hidden = layers.depth_m >= pixels.depth_m[place]
        free = np.where(hidden, 1 - pixels.fill[place], 1.0)[:, None]
        front = np.where(hidden[:, None], pixels.front[place], 0.0)
        behind, fill = pixels.rendered[place] - front, layers.fill[:, None]
        lit = layers.lit(colour.shape[1])
        segments = Segments(
            start=layers.start,
            colour=colour[layers.pixel],
            lit=lit,
            is_known=world.is_coloured[layers.kinds],
            share=fill * free,
            base=front + (1 - fill) * behind,
            variance=None,
            unresolved=None if rough else Neighbours.of(layers, world.camera).unresolved(lit),
        )
        return cls(segments, pixels.log_density[place], free, behind)

    def gains(self, noise: ColourNoise, fitted: Fit) -> NDArray[np.float64]:
        """What each would add to the log evidence (B,), by Laplace."""
        return laplace_evidence(self.segments, noise, fitted) - sums(self.segments.start, self.explained)


def forbidden(
    world: TableWorld,
    rest: Scene,
    kinds: NDArray[np.int64],
    poses: NDArray[np.float64],
    overlap_m: float = OVERLAP_M,
) -> NDArray[np.bool_]:
    """Which things (B,) would stand off the square or overlap the rest by more than so much."""
    outside = np.asarray((np.abs(poses[:, :2]) > world.half_m).any(axis=1))
    for kind, pose in zip(rest.kinds, rest.poses, strict=True):
        others = np.full(len(kinds), kind), np.broadcast_to(pose, poses.shape)
        outside |= overlap_depths(world, kinds, poses, *others)[0] > overlap_m
    return outside
