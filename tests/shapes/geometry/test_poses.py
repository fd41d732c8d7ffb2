import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapes.geometry.poses import poses_of, wxyz_from_xyzw, xyzw_from_wxyz


def test_quaternion_orders_agree_with_scipy(seed: int) -> None:
    """A rotation written xyzw by SciPy is the same rotation in our wxyz pose."""
    rotation = Rotation.random(rng=np.random.default_rng(seed))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.as_matrix()

    wxyz = poses_of(matrix)[:4]

    expected = wxyz_from_xyzw(rotation.as_quat())
    assert abs(wxyz @ expected) == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_array_equal(xyzw_from_wxyz(expected), rotation.as_quat())
