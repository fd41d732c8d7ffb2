"""Colours can be told apart, by colour-blind eyes too, and points without colour are shaded."""

from itertools import combinations

import numpy as np
import pytest
from skimage.color import deltaE_ciede2000, rgb2lab

from pipeline.colours import LOST, OBJECTS, PATH, object_colours, shaded

SIMULATED = {
    "normal": np.eye(3),
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
}
"""Of linear RGB, at full severity (Machado, Oliveira and Fernandes, 2009, table 1)."""


def as_seen(rgb: tuple[int, int, int], eyes: str) -> np.ndarray:
    """CIE Lab of a colour as these eyes see it."""
    coded = np.asarray(rgb) / 255
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.asarray(SIMULATED[eyes]) @ linear, 0, 1)
    return rgb2lab(np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055))


@pytest.mark.parametrize("eyes", SIMULATED)
def test_any_two_colours_of_objects_can_be_told_apart(eyes: str) -> None:
    """By a CIEDE2000 of 15 and more; so can the path and what was lost of it."""
    for one, other in [*combinations(OBJECTS, 2), (PATH, LOST)]:
        assert deltaE_ciede2000(as_seen(one, eyes), as_seen(other, eyes)) >= 15, (one, other)


def test_colours_go_to_what_was_found() -> None:
    """In the order of the search; from the eighth on they begin again."""
    found = np.array([False, True, False, True])
    assert object_colours(found) == {1: OBJECTS[0], 3: OBJECTS[1]}
    assert object_colours(np.ones(8, bool))[7] == OBJECTS[0]


def test_a_floor_is_brighter_than_a_wall_and_a_wall_than_a_ceiling() -> None:
    """As under a lamp, whatever direction is up; nothing is black."""
    for up in np.eye(3):
        ceiling, floor = (shaded((sign * 127 * up[None]).astype(np.int8), up)[0, 0] for sign in (-1, 1))
        walls = [shaded((127 * side[None]).astype(np.int8), up)[0, 0] for side in np.eye(3) if side @ up == 0]
        assert 50 < ceiling <= min(walls) < floor
