"""Nearly rigid matrices from text files, made rigid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_STRETCH = 0.1
"""By how much axes of a rotation may differ from length one; files with three digits are within 0.002."""


def orthonormalised(matrices: NDArray[np.floating]) -> NDArray[np.float64]:
    """Nearest rigid transforms (..., 4, 4) float64 to nearly rigid ones: the polar factor of the rotation.

    Recorded poses are often orthonormal to three digits only.

    Raises:
        ValueError: a matrix is not finite, or its rotation is a reflection or none.
    """
    matrices = np.asarray(matrices, np.float64)
    if not np.isfinite(matrices).all():
        raise ValueError("a pose is not finite")
    u, stretch, vt = np.linalg.svd(matrices[..., :3, :3])
    if (np.abs(stretch - 1) > _STRETCH).any():
        raise ValueError("a pose is no rotation: its axes are not of length one")
    rotation = u @ vt
    if (np.linalg.det(rotation) < 0).any():
        raise ValueError("a pose is a reflection, not a rotation")
    rigid = np.zeros_like(matrices)
    rigid[..., :3, :3] = rotation
    rigid[..., :3, 3] = matrices[..., :3, 3]
    rigid[..., 3, 3] = 1.0
    return rigid
