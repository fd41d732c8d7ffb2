import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapes.geometry.poses import orthonormalised, poses_of, wxyz_from_xyzw, xyzw_from_wxyz


def test_quaternion_orders_agree_with_scipy(seed: int) -> None:
    """A rotation written xyzw by SciPy is the same rotation in our wxyz pose."""
    rotation = Rotation.random(rng=np.random.default_rng(seed))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.as_matrix()

    wxyz = poses_of(matrix)[:4]

    expected = wxyz_from_xyzw(rotation.as_quat())
    assert abs(wxyz @ expected) == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_array_equal(xyzw_from_wxyz(expected), rotation.as_quat())


def test_orthonormalised_recovers_a_rotation_from_rounding(seed: int) -> None:
    """Rounding to three digits is undone to the size of the rounding, and the result is rigid."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    matrix[:3, 3] = [1.0, 2.0, 3.0]

    rigid = orthonormalised(matrix.round(3))

    np.testing.assert_allclose(rigid[:3, :3] @ rigid[:3, :3].T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rigid, matrix, atol=1e-3)


@pytest.mark.parametrize("broken", [np.diag([-1.0, 1, 1, 1]), np.full((4, 4), np.nan)])
def test_orthonormalised_refuses_what_is_no_pose(broken: np.ndarray) -> None:
    """A reflection or NaN is the caller's mistake."""
    with pytest.raises(ValueError, match="a pose is"):
        orthonormalised(broken)
