"""Textures of synthetic things: colours of vertices, by the name of the shape, the same in every film."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.synthesis.colours import shape_colour

EDGE_M = 0.006
"""Longest edge of painted triangles: every vertex has one colour, and colours blur over a triangle."""
COLOURS = ("", " label", " print")
"""Of a shape: its ground, and two more, drawn by its name with these words behind it."""
CELLS = (12, 6)
"""Of a print, round the upright and upwards."""

Places = NDArray[np.floating]


def painted(shape: str, mesh: trimesh.Trimesh, pattern: str, turn_rad: float = 0.0) -> trimesh.Trimesh:
    """The mesh, its triangles made small, with colours of its vertices.

    Args:
        shape: name of the shape, which decides its colours and prints.
        mesh: z up.
        pattern: of `PATTERNS`.
        turn_rad: by so much round the circle of hues all its colours are others.
    """
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, EDGE_M)[:2]
    fine = trimesh.Trimesh(vertices, faces)
    low, high = fine.bounds
    across = fine.vertices - (low + high) / 2
    height = (fine.vertices[:, 2] - low[2]) / (high[2] - low[2])
    layer = PATTERNS[pattern](shape, np.arctan2(across[:, 1], across[:, 0]), height)
    palette = np.array([shape_colour(shape + words, turn_rad) for words in COLOURS], np.uint8)
    return trimesh.Trimesh(fine.vertices, fine.faces, vertex_colors=palette[layer], process=False)


def pattern_of(shape: str) -> str:
    """The pattern of a shape, drawn by its name, none of them plain."""
    patterns = [one for one in PATTERNS if one != "plain"]
    return patterns[hashlib.sha256(f"{shape} pattern".encode()).digest()[0] % len(patterns)]


def _plain(shape: str, angle: Places, height: Places) -> NDArray[np.int_]:
    del shape, height
    return np.zeros(len(angle), int)


def _halves(shape: str, angle: Places, height: Places) -> NDArray[np.int_]:
    del shape, height
    return (angle > 0).astype(int)


def _stripes(shape: str, angle: Places, height: Places) -> NDArray[np.int_]:
    del shape, angle
    return np.floor(5 * height).astype(int) % 2


def _label(shape: str, angle: Places, height: Places) -> NDArray[np.int_]:
    """Cells of any of the three colours, all round; the ground above and below."""
    digest = hashlib.sha256(f"{shape} cells".encode()).digest()
    cells = np.random.default_rng(int.from_bytes(digest[:8])).integers(len(COLOURS), size=CELLS)
    turn = np.clip((angle / (2 * np.pi) + 0.5) * CELLS[0], 0, CELLS[0] - 1).astype(int)
    up = np.clip((height - 0.1) / 0.8 * CELLS[1], 0, CELLS[1] - 1).astype(int)
    return np.where(np.abs(height - 0.5) < 0.4, cells[turn, up], 0)


PATTERNS: Mapping[str, Callable[[str, Places, Places], NDArray[np.int_]]] = {
    "plain": _plain,
    "halves": _halves,
    "stripes": _stripes,
    "label": _label,
}
"""Which of a shape's colours vertices have, by its name and their angles (N,) and heights (N,), 0..1."""
