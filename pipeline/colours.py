"""Colours of objects, states and points, the same in every view, file and legend.

After Okabe and Ito, "Color Universal Design", 2008: colours that colour-blind eyes tell apart.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ORANGE, SKY_BLUE, GREEN, YELLOW = (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66)
VERMILION, PURPLE, GREY, WHITE = (213, 94, 0), (204, 121, 167), (160, 160, 160), (255, 255, 255)

OBJECTS = (
    *(ORANGE, SKY_BLUE, (0, 126, 92), (249, 244, 179)),
    *((47, 99, 128), (126, 87, 0), (153, 216, 199)),
)
"""Two of theirs, and lighter or darker shades of the others, chosen so that any two differ by a CIEDE2000 of
at least 15 to normal, deuteranope and protanope eyes (simulated after Machado, Oliveira, Fernandes, 2009)."""
PATH, LOST, TRUTH, TABLE = YELLOW, VERMILION, WHITE, GREY
SEEN, INFERRED, UNSEEN = GREEN, ORANGE, PURPLE
"""States of a learned shape's surface: some ray touched it; it closes the shape behind what was seen; nobody
knows what is there."""

BACKGROUND = (18, 20, 26)
"""Of views and charts, on which every one of these colours is seen."""
AMBIENT = 0.35
"""Share of light that reaches points turned away from the lamp, so that nothing is black."""


def object_colours(found: NDArray[np.bool_]) -> dict[int, tuple[int, int, int]]:
    """Of each object that was found, by its index (N,); from the eighth on they begin again."""
    return {one: OBJECTS[rank % len(OBJECTS)] for rank, one in enumerate(np.flatnonzero(found).tolist())}


def shaded(normals: NDArray[np.int8], up: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Greys (N, 3) of points without colour, as a lamp above and beside would show them (Lambert's law).

    Args:
        normals: (N, 3) of `RoomView`.
        up: unit vector (3,).
    """
    aside = np.cross(up, [0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    lamp = 0.8 * up + 0.6 * aside / np.linalg.norm(aside)
    lit = np.clip(normals.astype(np.float64) @ lamp / 127, 0, 1)
    grey = 255 * (AMBIENT + (1 - AMBIENT) * lit)
    return np.repeat((0.85 * grey).astype(np.uint8)[:, None], 3, axis=1)
