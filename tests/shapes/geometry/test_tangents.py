"""Rigid motions on the host are matrix exponentials."""

import numpy as np
import pytest
from scipy.linalg import expm

from shapes.geometry.poses import matrices_of, motions_of, poses_of, tangents_of

pytestmark = pytest.mark.usefixtures("double_precision")


def test_exponentials_and_logarithms_are_those_of_matrices(seed: int) -> None:
    """From angles of 1e-9 to 3 rad, to 1e-9; poses and matrices lead back to each other."""
    rng = np.random.default_rng(seed)
    tangents = rng.normal(size=(60, 6))
    turns = tangents[:, 3:]
    turns *= np.geomspace(1e-9, 3, 60)[:, None] / np.linalg.norm(turns, axis=1, keepdims=True)
    algebra = np.zeros((60, 4, 4))
    algebra[:, :3, :3] = np.cross(np.eye(3)[None], turns[:, None])
    algebra[:, :3, 3] = tangents[:, :3]
    expected = np.stack([expm(one) for one in algebra])

    matrices = motions_of(tangents)

    np.testing.assert_allclose(matrices, expected, atol=1e-9)
    np.testing.assert_allclose(tangents_of(matrices), tangents, atol=1e-9)
    np.testing.assert_allclose(matrices_of(poses_of(matrices)), matrices, atol=1e-12)
