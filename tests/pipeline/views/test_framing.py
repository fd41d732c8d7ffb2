"""The eye stands where the scene fills the picture and the path is in sight."""

import numpy as np
import pytest

from pipeline.views.framing import (
    CELLS,
    EYE_FOV_RAD,
    WIDE_ASPECT,
    Eye,
    chosen_eye,
    eye_before,
    projected,
    seen_from,
)

UP = np.array([0.0, -1.0, 0.0])


def room(rng: np.random.Generator) -> np.ndarray:
    """A floor and a wall, as a camera at the origin that looks along z sees them, and a few strays."""
    floor = np.stack([rng.uniform(-1.5, 1.5, 6000), np.full(6000, 1.0), rng.uniform(0.8, 3.0, 6000)], axis=1)
    wall = np.stack([rng.uniform(-1.5, 1.5, 6000), rng.uniform(-1.0, 1.0, 6000), np.full(6000, 3.0)], axis=1)
    return np.concatenate([floor, wall, rng.normal(0, 20, (300, 3))])


@pytest.mark.parametrize("step_m", [0.0, 0.02])
def test_a_room_fills_the_picture_and_the_path_is_inside(seed: int, step_m: float) -> None:
    """Also of a camera that stood still; strays at 20 m do not matter."""
    cloud = room(np.random.default_rng(seed))
    path = step_m * np.arange(30)[:, None] * [1.0, 0.0, 0.2]

    eye = chosen_eye(cloud, path, np.eye(4), UP)

    assert len(np.unique(projected(eye, cloud)[0])) > 0.5 * CELLS**2
    assert (projected(eye, path)[0] >= 0).all()
    assert (eye.target - eye.position)[2] > 0


def test_what_is_looked_at_stands_in_the_middle(seed: int) -> None:
    """A mug on the floor of the room."""
    cloud = room(np.random.default_rng(seed))
    mug = np.array([[0.5, 0.9, 1.5], [0.6, 1.0, 1.6]])

    eye = chosen_eye(cloud, mug, np.eye(4), UP, mug)

    cells = projected(eye, np.array([[0.55, 0.95, 1.55]]))[0]
    row, column = np.divmod(cells, CELLS)
    assert np.abs(np.concatenate([row, column]) - CELLS / 2).max() < CELLS / 4


def test_a_point_falls_where_a_pinhole_camera_sees_it() -> None:
    """To the right and below the middle, at the distance ahead."""
    eye = Eye(np.zeros(3), np.array([0.0, 0.0, 1.0]), UP)
    cells, depth = projected(eye, np.array([[0.2, 0.1, 1.0], [0.0, 0.0, -1.0], [2.0, 0.0, 1.0]]))

    row, column = divmod(int(cells[0]), CELLS)
    assert row > CELLS / 2
    assert column - CELLS / 2 > row - CELLS / 2
    assert depth[0] == pytest.approx(1.0)
    assert cells[1:].tolist() == [-1, -1]


def test_there_is_an_eye_without_a_room() -> None:
    """Of a single pose."""
    eye = chosen_eye(np.zeros((0, 3)), np.zeros((1, 3)), np.eye(4), UP)
    assert np.isfinite([eye.position, eye.target]).all()


def test_the_nearest_eye_has_all_points_inside(seed: int) -> None:
    """One of them at an edge of the panel, looked at from the side that was asked for."""
    points = np.random.default_rng(seed).uniform([0, 0, 0], [0.3, 0.2, 0.1], (200, 3))
    toward = np.array([0.6, -0.6, 0.5]) / np.linalg.norm([0.6, -0.6, 0.5])
    eye = eye_before(points, toward, np.array([0.0, 0.0, 1.0]))

    across, below, ahead = seen_from(eye, points).T
    half = np.tan(EYE_FOV_RAD / 2) * ahead
    share = np.maximum(abs(across) / (half * WIDE_ASPECT), abs(below) / half).max()
    assert 0.9 < share < 1.0
    np.testing.assert_allclose(np.cross(eye.position - eye.target, toward), 0, atol=1e-12)
