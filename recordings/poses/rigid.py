"""Nearly rigid matrices from text files, made rigid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def orthonormalised(matrices: NDArray[np.floating]) -> NDArray[np.float64]:
    """Nearest rigid transforms (..., 4, 4) float64 to nearly rigid ones: the polar factor of the rotation.

    Recorded poses are often orthonormal to three digits only.

    Raises:
        ValueError: a matrix is not finite or its rotation is a reflection.
    """
    matrices = np.asarray(matrices, np.float64)
    if not np.isfinite(matrices).all():
        raise ValueError("a pose is not finite")
    u, _, vt = np.linalg.svd(matrices[..., :3, :3])
    rotation = u @ vt
    if (np.linalg.det(rotation) < 0).any():
        raise ValueError("a pose is a reflection, not a rotation")
    rigid = np.zeros_like(matrices)
    rigid[..., :3, :3] = rotation
    rigid[..., :3, 3] = matrices[..., :3, 3]
    rigid[..., 3, 3] = 1.0
    return rigid
