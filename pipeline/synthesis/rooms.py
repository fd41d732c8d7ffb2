"""Rooms to film in: a shell of walls round the origin, and what stands inside.

The floor is z = 0 and the origin lies on it, under the object or table that is filmed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh
from manifold3d import Manifold
from numpy.typing import NDArray

from pipeline.synthesis.colours import muted_colour
from pipeline.synthesis.furniture import clutter_piece, free_piece, wall_piece
from pipeline.synthesis.solids import block, surface_of
from pipeline.synthesis.world import Part
from recordings.settings import check_finite

WALL_MARGIN_M = 0.3
"""Nothing stands nearer than this to the cameras."""


@dataclass(frozen=True, kw_only=True)
class RoomConfig:
    """What surrounds the object or table.

    Attributes:
        kind: `bare` is four walls; `furnished` adds furniture, pictures and a door; `cluttered` adds
            things on the floor; `curved` has a curved wall with columns; `none` is no room at all.
        width_m: mean extent in x; each room is drawn within `size_spread` of it.
        depth_m: mean extent in y.
        height_m: height of the ceiling.
        size_spread: largest relative change of width and depth.
        off_centre_m: largest shift of the walls against the origin along x and y; 0 leaves a bare
            rectangular room ambiguous under half turns.
        open_sides: walls left out.
    """

    kind: Literal["bare", "furnished", "cluttered", "curved", "none"] = "furnished"
    width_m: float = 5.0
    depth_m: float = 4.2
    height_m: float = 2.6
    size_spread: float = 0.15
    off_centre_m: float = 0.4
    open_sides: int = 0

    def __post_init__(self) -> None:
        check_finite(self)
        if min(self.width_m, self.depth_m, self.height_m) <= 0:
            raise ValueError("width_m, depth_m and height_m must be positive")
        if not 0 <= self.size_spread < 1 or self.off_centre_m < 0:
            raise ValueError("size_spread must lie in [0, 1) and off_centre_m must not be negative")
        if not 0 <= self.open_sides <= 4:
            raise ValueError(f"a room has 0 to 4 open sides, got {self.open_sides}")


def room_parts(config: RoomConfig, clear_radius_m: float, rng: np.random.Generator) -> list[Part]:
    """Shell and furniture; a circle of `clear_radius_m` round the origin stays empty.

    Rooms too small for the circle are made large enough for it.
    """
    if config.kind == "none":
        return []
    outline = _outline(config, clear_radius_m, rng)
    parts = [_shell(config, outline, rng)]
    if config.kind == "bare":
        return parts
    layout = _Layout(outline, clear_radius_m, rng)
    for _ in range(10 if config.kind != "curved" else 5):
        layout.add_at_wall(wall_piece(rng))
    for _ in range(4 if config.kind != "curved" else 7):
        layout.add_free(free_piece(rng))
    if config.kind == "cluttered":
        for _ in range(40):
            layout.add_free(clutter_piece(rng, rng.uniform(0.12, 0.5)))
    for _ in range(5):
        layout.add_at_wall(_wall_relief(rng), flat=True)
    return parts + layout.parts


def on_floor(place_m: NDArray[np.float64], yaw_rad: float) -> NDArray[np.float64]:
    """Pose (4, 4) of something that stands upright at a place (2,), turned about the vertical."""
    pose = trimesh.transformations.rotation_matrix(yaw_rad, [0, 0, 1])
    pose[:2, 3] = place_m
    return pose


def _outline(config: RoomConfig, clear_radius_m: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Corners (N, 2) of the floor, counter-clockwise, star-shaped about the origin."""
    size = np.array([config.width_m, config.depth_m]) * rng.uniform(
        1 - config.size_spread, 1 + config.size_spread, 2
    )
    shift = rng.uniform(-config.off_centre_m, config.off_centre_m, 2)
    half = np.maximum(size / 2, clear_radius_m + WALL_MARGIN_M + np.abs(shift))
    if config.kind != "curved":
        return np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half + shift
    angle = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    wave = sum(
        rng.uniform(0.02, 0.07) * np.cos(order * angle + rng.uniform(0, 2 * np.pi)) for order in (2, 3, 5)
    )
    radius = (1.15 + wave) / np.hypot(np.cos(angle) / half[0], np.sin(angle) / half[1])
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1) + shift


def _shell(config: RoomConfig, outline: NDArray[np.float64], rng: np.random.Generator) -> Part:
    """Walls over the outline's edges, floor and ceiling; the open sides' walls are left out."""
    count = len(outline)
    centre = np.zeros((1, 2))
    rings = [(outline, 0.0), (outline, config.height_m), (centre, 0.0), (centre, config.height_m)]
    vertices = np.concatenate([np.insert(ring, 2, height, axis=1) for ring, height in rings])
    middle = (outline + np.roll(outline, -1, axis=0)) / 2
    first_open = rng.integers(4)
    side = (np.round(np.arctan2(middle[:, 1], middle[:, 0]) / (np.pi / 2)).astype(int) - first_open) % 4
    faces = []
    for corner, following in zip(range(count), np.roll(range(count), -1), strict=True):
        if side[corner] >= config.open_sides:
            faces += [(corner, corner + count, following), (following, corner + count, following + count)]
        faces += [(corner, following, 2 * count), (following + count, corner + count, 2 * count + 1)]
    mesh = trimesh.Trimesh(vertices, np.array(faces), process=False)
    return Part(name="room", mesh=mesh, world_from_part=np.eye(4), colour=muted_colour(rng))


def _wall_relief(rng: np.random.Generator) -> Manifold:
    """A picture, a radiator or a door: a flat box whose back is at y = 0."""
    kind = rng.integers(3)
    if kind == 0:
        return block(0.95, 0.08, 2.05, y=0.04)
    if kind == 1:
        return block(rng.uniform(0.6, 1.4), 0.1, 0.6, y=0.05, z=0.15)
    width, height = rng.uniform(0.3, 1.0, size=2)
    return block(width, 0.04, height, y=0.02, z=rng.uniform(1.2, 2.2 - height / 2))


class _Layout:
    """Places pieces inside an outline so that their footprints keep apart and out of the clear circle."""

    def __init__(self, outline: NDArray[np.float64], clear_radius_m: float, rng: np.random.Generator) -> None:
        self.parts: list[Part] = []
        self._outline = outline
        self._clear_radius_m = clear_radius_m
        self._rng = rng
        self._taken: list[NDArray[np.float64]] = []

    def add_at_wall(self, piece: Manifold, *, flat: bool = False) -> None:
        """Stand a piece with its back to a random place of the wall, if there is room."""
        mesh = surface_of(piece)
        for _ in range(20):
            edge = self._rng.choice(len(self._outline), p=self._edge_lengths / self._edge_lengths.sum())
            start, end = self._outline[edge], self._outline[(edge + 1) % len(self._outline)]
            along = (end - start) / np.linalg.norm(end - start)
            inward = np.array([-along[1], along[0]])
            place = start + (end - start) * self._rng.uniform() - inward * mesh.bounds[0, 1]
            if self._try(mesh, on_floor(place, np.arctan2(inward[1], inward[0]) - np.pi / 2), flat=flat):
                return

    def add_free(self, piece: Manifold) -> None:
        """Stand a piece anywhere, if there is room."""
        mesh = surface_of(piece)
        low, high = self._outline.min(axis=0), self._outline.max(axis=0)
        for _ in range(20):
            if self._try(mesh, on_floor(self._rng.uniform(low, high), self._rng.uniform(0, 2 * np.pi))):
                return

    @property
    def _edge_lengths(self) -> NDArray[np.float64]:
        return np.linalg.norm(np.roll(self._outline, -1, axis=0) - self._outline, axis=-1)

    def _try(self, mesh: trimesh.Trimesh, pose: NDArray[np.float64], *, flat: bool = False) -> bool:
        corners = np.linspace(mesh.bounds[0, :2], mesh.bounds[1, :2], 9)
        ground = np.stack([*np.meshgrid(*corners.T), np.zeros((9, 9))], axis=-1).reshape(-1, 3)
        footprint = trimesh.transform_points(ground, pose)[:, :2]
        if np.linalg.norm(footprint, axis=-1).min() < self._clear_radius_m + WALL_MARGIN_M / 2:
            return False
        if not flat and not _inside(self._outline, footprint):
            return False
        box = np.stack([footprint.min(axis=0), footprint.max(axis=0)])
        if any((box[0] < other[1]).all() and (other[0] < box[1]).all() for other in self._taken):
            return False
        self._taken.append(box)
        name = f"furniture {len(self.parts)}"
        self.parts.append(Part(name=name, mesh=mesh, world_from_part=pose, colour=muted_colour(self._rng)))
        return True


def _inside(outline: NDArray[np.float64], points: NDArray[np.float64]) -> bool:
    """True if every point (N, 2) lies inside a star-shaped counter-clockwise outline, to 1 cm."""
    following = np.roll(outline, -1, axis=0)
    edge = (following - outline) / np.linalg.norm(following - outline, axis=-1, keepdims=True)
    polar = np.arctan2(outline[:, 1], outline[:, 0])
    sector = (np.arctan2(points[:, 1], points[:, 0])[:, None] - polar) % (2 * np.pi)
    chosen = sector.argmin(axis=1)
    offset = points - outline[chosen]
    return bool((edge[chosen, 0] * offset[:, 1] - edge[chosen, 1] * offset[:, 0] > -0.01).all())
