"""Grids of orientations for the search: resting, cubic and evenly spread."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

RESTING, FREE = 416, 576
"""Orientations that are tried of an object that may stand on something, and of one that hangs in the air."""

YAWS = 24


def tried_rotations(
    rests: NDArray[np.floating] | None, frame_from_table: NDArray[np.floating] | None = None
) -> NDArray[np.float32]:
    """Rotations (n, 3, 3) into a frame: resting, the cube's 24, and an even spread.

    Args:
        rests: (R, 3) directions that may point down; None where nothing stands: an even spread alone.
        frame_from_table: (3, 3); None where the frame has the table's axes, z up.
    """
    if rests is None:
        return spread_rotations(FREE).astype(np.float32)
    fixed = np.concatenate([resting_rotations(rests, YAWS), cube_rotations()])
    fixed = fixed if frame_from_table is None else frame_from_table @ fixed
    return np.concatenate([fixed, spread_rotations(RESTING - len(fixed))]).astype(np.float32)


def cube_rotations() -> NDArray[np.float64]:
    """The 24 rotations (24, 3, 3) of a cube onto itself."""
    signed = [
        np.diag(signs)[list(order)]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]
    return np.array([matrix for matrix in signed if np.linalg.det(matrix) > 0])


def spread_rotations(count: int) -> NDArray[np.float64]:
    """Rotations (n, 3, 3) spread evenly over all (super-Fibonacci spiral, Alexa 2022)."""
    psi = 1.533751168755204288118041
    place = np.arange(count) + 0.5
    low, high = np.sqrt(place / count), np.sqrt(1 - place / count)
    first, second = 2 * np.pi * place / np.sqrt(2), 2 * np.pi * place / psi
    xyzw = [low * np.sin(first), low * np.cos(first), high * np.sin(second), high * np.cos(second)]
    return Rotation.from_quat(np.stack(xyzw, axis=1)).as_matrix()


def resting_rotations(rests: NDArray[np.floating], yaws: int) -> NDArray[np.float64]:
    """Rotations (R * yaws, 3, 3) into a frame with z up, in which each rest's direction points down."""
    down = np.array([0.0, 0.0, -1.0])
    turns = Rotation.from_rotvec(np.outer(np.arange(yaws) * 2 * np.pi / yaws, -down)).as_matrix()
    upright = np.array([Rotation.align_vectors(down, rest)[0].as_matrix() for rest in rests])
    return (turns[None] @ upright[:, None]).reshape(-1, 3, 3)
