"""Renderings of single things: which pixels each fills, how far, with what, and how that changes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics
from scene.colour.world import TableWorld
from shapes.rendering.rasterising import Fragments, image_velocities, rasterise

TOGETHER = 96
"""Poses rendered at once: corners of 6,000 triangles stay in a core's cache."""
SAMPLES = 2
"""Along each side of a pixel, of what is shaded: a step between triangles moves a pixel by a quarter."""
UNRESOLVED = 1 / 96
"""Mean square, over that of its second difference, of how far a pixel's mean is off by a step between
triangles: 1/48 of its height squared where it crosses a pixel of two samples, nothing in the one beside."""


@dataclass(frozen=True, eq=False)
class Layers:
    """B things, each rendered alone; those of thing b are rows `start[b]` to `start[b + 1]`.

    Attributes:
        start: (B + 1,).
        pixel: (P,) row * width + column.
        depth_m: (P,).
        shade: (P,).
        tint: (P, 3 or 1) colour of what is seen, 1 where nothing is known; (P, 1) if nothing is of any kind.
        fill: (P,) share of the pixel that is covered.
        kinds: (B,).
    """

    start: NDArray[np.int64]
    pixel: NDArray[np.int64]
    depth_m: NDArray[np.floating]
    shade: NDArray[np.floating]
    tint: NDArray[np.floating]
    fill: NDArray[np.floating]
    kinds: NDArray[np.int64]

    def lit(self, channels: int) -> NDArray[np.float64]:
        """What each pixel returns of white light (P, C), or (P, 1) where no colours are known."""
        return self.shade[:, None] * self.tint_of(channels)

    def tint_of(self, channels: int) -> NDArray[np.floating]:
        """Colours (P, C); a grey image's mean."""
        return self.tint.mean(axis=1, keepdims=True) if channels == 1 else self.tint

    @property
    def owner(self) -> NDArray[np.int64]:
        """Thing (P,) of each pixel."""
        return np.repeat(np.arange(len(self.kinds)), np.diff(self.start))

    def of(self, things: NDArray[np.int64]) -> Layers:
        """Of some things, in the order given."""
        counts = np.diff(self.start)[things]
        start = np.concatenate([[0], np.cumsum(counts)])
        rows = np.arange(start[-1]) + np.repeat(self.start[things] - start[:-1], counts)
        of_pixels = {name: getattr(self, name)[rows] for name in OF_PIXELS}
        return Layers(start=start, kinds=self.kinds[things], **of_pixels)


OF_PIXELS = "pixel", "depth_m", "shade", "tint", "fill"
"""What `Layers` tell of each pixel."""


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Rows of layers' pixels that show the same thing a pixel on.

    Attributes:
        ahead: (2, P) to the right and below; the pixel's own where the thing ends.
        behind: (2, P) to the left and above.
    """

    ahead: NDArray[np.int64]
    behind: NDArray[np.int64]

    @classmethod
    def of(cls, layers: Layers, camera: CameraIntrinsics) -> Neighbours:
        """Within each thing."""
        stride = camera.width + 2
        row, column = np.divmod(layers.pixel, camera.width)
        place = (layers.owner * (camera.height + 2) + row + 1) * stride + column + 1
        mine = np.arange(len(place))
        rows = np.full(len(layers.kinds) * (camera.height + 2) * stride, -1)
        rows[place] = mine
        near = [rows[place + apart] for apart in (1, stride, -1, -stride)]
        near = [np.where(one < 0, mine, one) for one in near]
        return cls(np.stack(near[:2]), np.stack(near[2:]))

    def slopes(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of values (P, C) along columns and rows, (2, P, C); one-sided at ends."""
        mine = np.arange(len(values))
        apart = (self.ahead != mine).astype(np.int8) + (self.behind != mine)
        return (values[self.ahead] - values[self.behind]) / np.maximum(apart, 1)[..., None]

    def unresolved(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviation (P, C) of a pixel's mean about the value (P, C) at its centre."""
        bends = values[self.ahead] + values[self.behind] - 2 * values
        return np.sqrt(UNRESOLVED * (bends**2).sum(axis=0))


@dataclass(frozen=True, eq=False)
class Motion:
    """How the pixels of layers change with (x, y, yaw) of their thing.

    Attributes:
        fill: (P, 3) of the share that is covered.
        shade: (P, 3) of what is seen there, as the same triangle turns.
        velocity: (P, 3, 2) columns and rows by which what is seen there moves.
    """

    fill: NDArray[np.float64]
    shade: NDArray[np.float64]
    velocity: NDArray[np.float64]


def render(world: TableWorld, kinds: NDArray[np.int64], poses: NDArray[np.float64]) -> Layers:
    """Things (B,) of these kinds at poses (B, 3), each alone."""
    return render_with_normals(world, kinds, poses)[0]


def render_with_normals(
    world: TableWorld, kinds: NDArray[np.int64], poses: NDArray[np.float64], samples: int = SAMPLES
) -> tuple[Layers, NDArray[np.float64]]:
    """`render`, and the unit normals (P, 3) of what each pixel shows, from which any lamp's shades follow."""
    if len(kinds) <= TOGETHER:
        poses = _unspun(world, kinds, poses)
        return _layers(world, kinds, poses, _fragments(world, kinds, poses, None, samples))
    parts = [
        render_with_normals(world, kinds[first : first + TOGETHER], poses[first : first + TOGETHER], samples)
        for first in range(0, len(kinds), TOGETHER)
    ]
    every = [layers for layers, _ in parts]
    start = np.append(0, np.cumsum(np.concatenate([np.diff(one.start) for one in every])))
    of_pixels = {name: np.concatenate([getattr(one, name) for one in every]) for name in OF_PIXELS}
    normals = np.concatenate([normals for _, normals in parts])
    return Layers(start=start, kinds=kinds, **of_pixels), normals


def render_with_motion(
    world: TableWorld, kinds: NDArray[np.int64], poses: NDArray[np.float64], samples: int = SAMPLES
) -> tuple[Layers, Motion]:
    """`render`, and how it changes with the poses."""
    poses = _unspun(world, kinds, poses)
    rotation = world.camera_from_world[:3, :3]
    twists = np.zeros((len(kinds), 3, 6))
    twists[:, :2, :3] = rotation[:, :2].T
    twists[:, 2, 3:] = rotation[:, 2]
    origins = poses[:, :2] @ rotation[:, :2].T + world.camera_from_world[:3, 3]
    twists[:, 2, :3] = -np.cross(rotation[:, 2], origins)
    fragments = _fragments(world, kinds, poses, twists, samples)
    layers, normals = _layers(world, kinds, poses, fragments)
    camera = world.camera
    row, column = np.divmod(layers.pixel, camera.width)
    depth_m = layers.depth_m[:, None]
    points = camera.rays(column, row) * depth_m
    velocity = image_velocities(points[:, None], 1 / depth_m, twists[layers.owner], camera)
    shade = np.zeros((len(points), 3))
    shade[:, 2] = world.light.turned_shade(normals)
    return layers, Motion(fragments.fill_change, shade, velocity[:, 0])


def _unspun(world: TableWorld, kinds: NDArray[np.int64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses whose round things have yaw 0: the corners of their triangles are no part of the model."""
    yaw = np.where(world.spins[kinds], 0.0, poses[:, 2])
    return np.column_stack([poses[:, :2], yaw])


def _fragments(
    world: TableWorld,
    kinds: NDArray[np.int64],
    poses: NDArray[np.float64],
    twists: NDArray[np.float64] | None,
    samples: int,
) -> Fragments:
    world_from_thing = np.tile(np.eye(4), (len(poses), 1, 1))
    cosine, sine = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    world_from_thing[:, :2, :2] = np.stack([cosine, -sine, sine, cosine], axis=1).reshape(-1, 2, 2)
    world_from_thing[:, :2, 3] = poses[:, :2]
    return rasterise(
        world.meshes, kinds, world.camera_from_world @ world_from_thing, world.camera, twists, samples
    )


def _layers(
    world: TableWorld, kinds: NDArray[np.int64], poses: NDArray[np.float64], seen: Fragments
) -> tuple[Layers, NDArray[np.float64]]:
    """And the mean normals (P, 3) of the pixels' samples, shorter where these differ."""
    count = np.diff(seen.first)
    owner = np.repeat(np.repeat(np.arange(len(kinds)), np.diff(seen.start)), count)
    face = world.first_faces[kinds[owner]] + seen.face
    rotation, origin = world.camera_from_world[:3, :3], world.camera_from_world[:3, 3]
    points = (world.camera.rays(seen.column, seen.row) * seen.sample_depth_m[:, None] - origin) @ rotation
    points[:, :2] -= poses[owner, :2]
    cosine, sine = np.cos(poses[owner, 2]), np.sin(poses[owner, 2])
    level, slope = world.face_normals
    normals = level[face] + np.einsum("pij,pj->pi", slope[face], _turned(points, cosine, -sine))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals, tint = _turned(normals, cosine, sine), world.face_tints[face]
    shade = world.light.shade(normals)
    if len(count) and count.max() > 1:
        normals, tint, shade = (
            (np.add.reduceat(one, seen.first[:-1], axis=0).T / count).T for one in (normals, tint, shade)
        )
    return Layers(seen.start, seen.pixel, seen.depth_m, shade, tint, seen.fill, kinds), normals


def _turned(
    vectors: NDArray[np.float64], cosine: NDArray[np.float64], sine: NDArray[np.float64]
) -> NDArray[np.float64]:
    """About z (P, 3)."""
    x, y, z = vectors.T
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1)
