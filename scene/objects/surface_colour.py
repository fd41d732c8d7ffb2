"""Colour of an object's surface, and the turns after which its shape alone looks the same.

Colours are logs of light in three orthonormal components, brightness and two of hue, so that a light's gain
is added to them. They are kept in the voxels along the surface, each the mean over its part of it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scene.objects.symmetry import SPINS, even_turns, leaves_alike, products, spins_freely

DARK = 0.01
"""Of full light, added before logs are taken: what is darker differs by noise and reflections alone."""
COMPONENTS = np.array([[1, 1, 1], [1, -1, 0], [1, 1, -2]]) / np.sqrt([[3], [2], [6]])
"""Rows: brightness, red against green, both against blue; orthonormal."""

LONGEST_VOXELS = 48
"""Along the longest edge of the box: 4 mm of 20 cm, as much as a pixel of the search's window covers."""
SAMPLES = 60_000
"""Of the surface: several a voxel of the largest grid."""
MARGIN = 2
"""Voxels round the surface that take the nearest colour: poses and shapes are that wrong in the search."""

APART_RAD = np.radians(5.0)
"""Turns closer than that are one."""
MOST_TURNS = 64
ALIKE_COLOURS = 0.1
"""Mean difference of colours, in logs, up to which they are alike: that of a twentieth of a thing in another
colour altogether; stripes that run round a thing differ by half of it, from voxel to voxel."""
TOLD_BY = 4096
"""Points of the surface whose colours are compared."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceColour:
    """Colours along a surface, in the box frame.

    Attributes:
        values: (X, Y, Z, 3) float32 as `components_of_light`; zero away from the surface.
        origin_m: (3,) corner of voxel (0, 0, 0).
        pitch_m: edge of a voxel.
        is_known: False where the whole surface has one colour that nobody knows.
        turns: (T, 4, 4) after which the shape looks the same; the identity first.
        looks: (L, 4, 4) those of them after which its colours do not.
        spins: whether these are steps of a turn by any angle.
        exact: whether all of them leave the shape as it is; else some are symmetries of its box that depth
            may tell.
    """

    values: NDArray[np.float32]
    origin_m: NDArray[np.float64]
    pitch_m: float
    is_known: bool
    turns: NDArray[np.float64]
    looks: NDArray[np.float64]
    spins: bool
    exact: bool

    def at(self, points_m: NDArray[np.floating]) -> NDArray[np.float32]:
        """Colours (..., 3) of points (..., 3) on the surface."""
        cell = np.floor((points_m - self.origin_m) / self.pitch_m).astype(int)
        x, y, z = np.moveaxis(np.clip(cell, 0, np.array(self.values.shape[:3]) - 1), -1, 0)
        return self.values[x, y, z]

    def told_apart(self, turns: NDArray[np.float64], points_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Those of the turns (T, 4, 4) after which points (P, 3) of the surface show other colours."""
        chosen, shown = list[NDArray[np.float64]](), list[NDArray[np.float32]]()
        for turn in turns:
            colours = self.at((points_m - turn[:3, 3]) @ turn[:3, :3])
            if all(np.abs(colours - before).mean() > ALIKE_COLOURS for before in shown):
                chosen.append(turn)
                shown.append(colours)
        return np.stack(chosen)


def components_of_light(light: NDArray[np.floating]) -> NDArray[np.float64]:
    """Log light (..., 3) in `COMPONENTS` of light (..., 3) in 0..1."""
    return np.log(light + DARK) @ COMPONENTS.T


def surface_colour(
    mesh: trimesh.Trimesh,
    rgb: NDArray[np.uint8] | None,
    gamma: float,
    lines: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int_]],
) -> SurfaceColour:
    """The colours of a surface.

    Args:
        mesh: in the box frame.
        rgb: (V, 3) of its vertices; None where nobody knows them.
        gamma: exponent by which stored values become light.
        lines: the continuous line (2, 3), the lines of order two and four (3, 2, 3), their orders (3,), as
            `scene.objects.symmetry` finds them.
    """
    points, places = _sampled(mesh, SAMPLES)
    pitch_m = float(np.ptp(mesh.bounds, axis=0).max()) / LONGEST_VOXELS
    origin_m = mesh.bounds[0] - MARGIN * pitch_m
    size = np.ceil(np.ptp(mesh.bounds, axis=0) / pitch_m).astype(int) + 2 * MARGIN + 1
    values = np.zeros((*size, 3), np.float32)
    if rgb is not None:
        shown = components_of_light(_light_at(mesh, points, places, rgb, gamma))
        values = _along_surface(points, shown, origin_m, pitch_m, tuple(size.tolist()))
    bare = SurfaceColour(
        values=values,
        origin_m=origin_m,
        pitch_m=pitch_m,
        is_known=rgb is not None,
        turns=np.eye(4)[None],
        looks=np.eye(4)[None],
        spins=False,
        exact=True,
    )
    if rgb is None:
        return bare
    turns, spins, exact = alike_turns(points, *lines)
    looks = bare.told_apart(turns, points[:TOLD_BY])
    return replace(bare, turns=turns, looks=looks, spins=spins, exact=exact)


def light_of_triangles(
    few: trimesh.Trimesh, mesh: trimesh.Trimesh, rgb: NDArray[np.uint8], gamma: float
) -> NDArray[np.float64]:
    """Light (F, 3) in 0..1 that the triangles of a mesh return, each the mean over its part of a finer one.

    Args:
        few: the mesh, in the same frame as the finer one.
        mesh: with colours.
        rgb: (V, 3) of its vertices.
        gamma: exponent by which stored values become light.
    """
    points, places = _sampled(mesh, SAMPLES)
    light = _light_at(mesh, points, places, rgb, gamma)
    middles = few.triangles_center
    owner = KDTree(middles).query(points)[1]
    counts = np.bincount(owner, minlength=len(middles))
    sums = np.stack([np.bincount(owner, light[:, one], len(middles)) for one in range(3)], axis=1)
    nearest = light[KDTree(points).query(middles)[1]]
    return np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], nearest)


def _light_at(
    mesh: trimesh.Trimesh,
    points: NDArray[np.float64],
    places: NDArray[np.int_],
    rgb: NDArray[np.uint8],
    gamma: float,
) -> NDArray[np.float64]:
    """Light (P, 3) of points on triangles (P,), between those of the corners."""
    corners = mesh.faces[places]
    weights = trimesh.triangles.points_to_barycentric(mesh.vertices[corners], points)
    light = (rgb[corners].astype(np.float64) / 255) ** gamma
    return np.asarray((weights[..., None] * light).sum(axis=1).clip(0, 1))


def _sampled(mesh: trimesh.Trimesh, count: int) -> tuple[NDArray[np.float64], NDArray[np.int_]]:
    drawn = trimesh.sample.sample_surface(mesh, count, seed=0)
    return np.asarray(drawn[0]), np.asarray(drawn[1])


def _along_surface(
    points: NDArray[np.float64],
    colours: NDArray[np.float64],
    origin_m: NDArray[np.float64],
    pitch_m: float,
    size: tuple[int, int, int],
) -> NDArray[np.float32]:
    """Means (X, Y, Z, 3) over points in each voxel; voxels beside them take the nearest one's."""
    flat = np.ravel_multi_index(tuple(((points - origin_m) / pitch_m).astype(int).T), size)
    filled, place, counts = np.unique(flat, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(place, colours[:, one]) for one in range(3)], axis=1)
    means = sums / counts[:, None]
    cells = np.stack(np.unravel_index(filled, size), axis=1)
    steps = np.array(list(itertools.product(range(-MARGIN, MARGIN + 1), repeat=3)))
    beside = (cells[:, None] + steps).reshape(-1, 3)
    beside = np.unique(np.clip(beside, 0, np.array(size) - 1), axis=0)
    values = np.zeros((*size, 3), np.float32)
    values[tuple(beside.T)] = means[KDTree(cells).query(beside)[1]]
    return values


def alike_turns(
    points: NDArray[np.float64],
    spin_line: NDArray[np.float64],
    lines: NDArray[np.float64],
    orders: NDArray[np.int_],
) -> tuple[NDArray[np.float64], bool, bool]:
    """Turns (T, 4, 4) after which a surface looks the same but for its colours.

    And whether any angle is one, and whether they are `exact`.

    Args:
        points: (P, 3) of the surface, in random order.
        spin_line: (2, 3) direction and point; zeros without one.
        lines: (3, 2, 3) of turns of order two and four.
        orders: (3,) 4, 2 or 0.
    """
    tree = KDTree(points)
    free = spins_freely(points, spin_line)
    generators = [even_turns(spin_line, SPINS) if free else np.eye(4)[None]]
    generators += [even_turns(line, int(order)) for line, order in zip(lines, orders, strict=True) if order]
    chosen: list[NDArray[np.float64]] = []
    for turn in products(reversed(generators)):
        known = np.array([one[:3, :3] for one in chosen]).reshape(-1, 3, 3)
        traces = np.einsum("tij,ij->t", known, turn[:3, :3])
        if not (traces > 1 + 2 * np.cos(APART_RAD)).any():
            chosen.append(turn)
    chosen = chosen[:MOST_TURNS]
    return np.stack(chosen), free, all(leaves_alike(tree, points, turn) for turn in chosen)
