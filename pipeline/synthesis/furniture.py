"""Pieces of furniture and clutter: solids that stand on z = 0 with their back at the side of negative y."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from manifold3d import Manifold

from pipeline.synthesis.solids import SEGMENTS, block, cylinder, polygon, union


def table(width: float, depth: float, height: float) -> Manifold:
    """A top of 3 cm on four legs."""
    legs = [
        block(0.05, 0.05, height - 0.02, side_x * (width / 2 - 0.06), side_y * (depth / 2 - 0.06))
        for side_x in (-1, 1)
        for side_y in (-1, 1)
    ]
    return union(block(width, depth, 0.03, z=height - 0.03), *legs)


def pedestal(radius: float, height: float) -> Manifold:
    """A round stand with a foot and a top plate."""
    column = cylinder(height - 0.01, 0.6 * radius)
    plate = cylinder(0.04, radius).translate((0, 0, height - 0.04))
    return column + plate + cylinder(0.03, radius)


def wall_piece(rng: np.random.Generator) -> Manifold:
    """A random piece that stands with its back to a wall."""
    return _WALL_PIECES[rng.integers(len(_WALL_PIECES))](rng)


def free_piece(rng: np.random.Generator) -> Manifold:
    """A random piece that stands anywhere in a room."""
    return _FREE_PIECES[rng.integers(len(_FREE_PIECES))](rng)


def clutter_piece(rng: np.random.Generator, size: float) -> Manifold:
    """A box, can, ball or wedge of about `size` metres."""
    x, y, z = rng.uniform(0.5, 1.2, size=3) * size
    kind = rng.integers(4)
    if kind == 0:
        return block(x, y, z)
    if kind == 1:
        return cylinder(z, x / 2)
    if kind == 2:
        return Manifold.sphere(x / 2, SEGMENTS).translate((0, 0, x / 2))
    return polygon([(0, 0), (x, 0), (0, z)]).extrude(y).rotate((90, 0, 0)).translate((-x / 2, y / 2, 0))


def chair(rng: np.random.Generator) -> Manifold:
    """A chair that faces along positive y."""
    seat = table(0.45, 0.45, rng.uniform(0.42, 0.48))
    return seat + block(0.45, 0.04, rng.uniform(0.85, 1.0), y=-0.2)


def _desk(rng: np.random.Generator) -> Manifold:
    width = rng.uniform(1.0, 1.6)
    return table(width, 0.7, 0.74) + block(0.5, 0.06, 0.36, x=rng.uniform(-0.2, 0.2), y=-0.1, z=0.74)


def shelf(rng: np.random.Generator) -> Manifold:
    """An open shelf."""
    width, height = rng.uniform(0.6, 1.2), rng.uniform(1.2, 2.1)
    boards = [block(width, 0.3, 0.02, z=z) for z in np.linspace(0, height - 0.02, rng.integers(4, 7))]
    frame = [block(0.02, 0.3, height, x=side * width / 2) for side in (-1, 1)]
    return union(*boards, *frame, block(width, 0.02, height, y=-0.14))


def _cupboard(rng: np.random.Generator) -> Manifold:
    width, height = rng.uniform(0.5, 1.1), rng.uniform(0.7, 2.0)
    body = block(width, 0.45, height)
    return body + block(width / 2 - 0.02, 0.03, height - 0.1, x=width / 4, y=0.225, z=0.05)


def _sofa(rng: np.random.Generator) -> Manifold:
    width = rng.uniform(1.4, 2.0)
    back = cylinder(width, 0.14).rotate((0, 90, 0))
    parts = [
        block(width, 0.8, 0.42),
        block(width, 0.24, 0.78, y=-0.3),
        back.translate((-width / 2, -0.3, 0.74)),
    ]
    parts += [block(0.2, 0.8, 0.6, x=side * width / 2) for side in (-1, 1)]
    return union(*parts)


def _bed(rng: np.random.Generator) -> Manifold:
    width = rng.uniform(0.9, 1.6)
    pillow = Manifold.sphere(0.5, SEGMENTS).scale((width * 0.8, 0.4, 0.25)).translate((0, -0.7, 0.5))
    return block(width, 2.0, 0.5) + block(width, 0.06, 0.9, y=-0.98) + pillow


def _stairs(rng: np.random.Generator) -> Manifold:
    width, steps = rng.uniform(0.8, 1.2), int(rng.integers(4, 9))
    treads = [block(width, 0.26, 0.17 * (step + 1), y=-0.26 * step) for step in range(steps)]
    return union(*treads)


def _column(rng: np.random.Generator) -> Manifold:
    radius = rng.uniform(0.12, 0.25)
    base = block(2.4 * radius, 2.4 * radius, 0.2)
    return base + cylinder(2.5, radius)


def _plant(rng: np.random.Generator) -> Manifold:
    pot = cylinder(0.3, 0.13, 0.17)
    leaves = [
        Manifold.sphere(rng.uniform(0.12, 0.24), 24).translate(
            (*rng.normal(scale=0.12, size=2), rng.uniform(0.5, 1.1))
        )
        for _ in range(6)
    ]
    return union(pot, cylinder(0.9, 0.02), *leaves)


def _lamp(rng: np.random.Generator) -> Manifold:
    height = rng.uniform(1.3, 1.7)
    shade = cylinder(0.25, 0.22, 0.12).translate((0, 0, height))
    return cylinder(0.03, 0.16) + cylinder(height + 0.05, 0.015) + shade


def _round_table(rng: np.random.Generator) -> Manifold:
    return pedestal(rng.uniform(0.3, 0.5), rng.uniform(0.5, 0.75))


Builder = Callable[[np.random.Generator], Manifold]
_WALL_PIECES: tuple[Builder, ...] = (_desk, shelf, _cupboard, _sofa, _bed, _stairs)
_FREE_PIECES: tuple[Builder, ...] = (chair, _column, _plant, _lamp, _round_table)
