"""Labels of objects in the 3D view: on poles so high that none covers another, and seen as a whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.views.framing import ASPECT, EYE_FOV_RAD, Eye, seen_from

LETTER, LINE = 0.0148, 0.061
"""Width of a letter and height of a label, in half heights of the 3D panel in a picture of 1600 x 1000."""
RISE, HIGHEST = 0.1, 6.0
"""By which a pole that is in the way grows, and how far at most; in heights that it has alone."""
BACK, STEPS_BACK = 1.06, 8
"""By which the eye goes away from what it looks at while a label is cut at an edge, and how often at most."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Flag:
    """A label on a pole.

    Attributes:
        text: of the label, centred below the pole's top.
        foot_m: (3,) where the pole begins, in the reference frame.
        height_m: of the pole.
    """

    text: str
    foot_m: NDArray[np.float64]
    height_m: float


def raised(eye: Eye, flags: Mapping[str, Flag]) -> tuple[Eye, dict[str, Flag]]:
    """An eye so far away that no label is cut at an edge, and the flags on poles of heights to match."""
    for _ in range(STEPS_BACK):
        found = _apart(eye, flags)
        if all(_is_inside(_box(eye, flag)) for flag in found.values()):
            break
        eye = replace(eye, position=eye.target + BACK * (eye.position - eye.target))
    return eye, _apart(eye, flags)


def _apart(eye: Eye, flags: Mapping[str, Flag]) -> dict[str, Flag]:
    """Flags of which none covers another: the lowest stays, those above it rise."""
    placed: dict[str, Flag] = {}
    for name, flag in sorted(flags.items(), key=lambda one: -_box(eye, one[1])[1, 1]):
        taken = [_box(eye, other) for other in placed.values()]
        higher = flag
        while _covers(_box(eye, higher), taken) and higher.height_m < HIGHEST * flag.height_m:
            higher = replace(higher, height_m=higher.height_m + RISE * flag.height_m)
        placed[name] = higher
    return {name: placed[name] for name in flags}


def _box(eye: Eye, flag: Flag) -> NDArray[np.float64]:
    """Corners (2, 2) of a label in the picture, to the right and below its middle, in half heights."""
    right, below, ahead = seen_from(eye, (flag.foot_m + flag.height_m * eye.up)[None])[0]
    top = np.array([right, below]) / (np.tan(EYE_FOV_RAD / 2) * max(ahead, 1e-3))
    half_width = LETTER * len(flag.text) / 2
    return top + np.array([[-half_width, 0.0], [half_width, LINE]])


def _covers(box: NDArray[np.float64], others: list[NDArray[np.float64]]) -> bool:
    return any(((box[0] < other[1]) & (other[0] < box[1])).all() for other in others)


def _is_inside(box: NDArray[np.float64]) -> bool:
    return bool((box[0] > [-ASPECT, -1]).all() and (box[1] < [ASPECT, 1]).all())
