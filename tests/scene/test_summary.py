"""What samples say of an object's pose."""

import numpy as np
from scipy.spatial.transform import Rotation

from scene.summary import LINKED, pose_modes, second_moment


def poses_at(rotations: Rotation, places_m: np.ndarray) -> np.ndarray:
    """(S, 4, 4)."""
    poses = np.tile(np.eye(4), (len(places_m), 1, 1))
    poses[:, :3, :3] = rotations.as_matrix()
    poses[:, :3, 3] = places_m
    return poses


def test_two_modes_5_cm_apart_are_told_as_two(seed: int) -> None:
    """With their shares, and a spread that spans both: the moment about the first is 2 mm and 5 cm."""
    places = np.random.default_rng(seed).normal(0.0, 0.002, (300, 3))
    places[::3, 0] += 0.05
    samples = poses_at(Rotation.identity(300), places)

    modes = pose_modes(samples)

    np.testing.assert_allclose(modes.shares, [2 / 3, 1 / 3, 0, 0])
    np.testing.assert_array_equal(modes.labels == 1, np.arange(300) % 3 == 0)
    np.testing.assert_allclose(modes.centres[:2, 0, 3], [0.0, 0.05], atol=0.001)
    moment = second_moment(samples, modes.centres[0])
    np.testing.assert_allclose(moment[0, 0], 0.05**2 / 3 + 0.002**2, rtol=0.05)
    np.testing.assert_allclose(moment[3:, 3:], 0, atol=1e-12)


def test_a_box_turned_by_half_a_turn_is_told_with_both_shares(seed: int) -> None:
    """In place: its middle has one spread, its orientation two modes."""
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(np.pi * (np.arange(200) % 4 == 0)[:, None] * [0.0, 0.0, 1.0])
    samples = poses_at(turns * Rotation.from_rotvec(rng.normal(0, 0.02, (200, 3))), np.zeros((200, 3)))

    modes = pose_modes(samples)

    np.testing.assert_allclose(modes.shares[:2], [0.75, 0.25])
    assert np.sqrt(second_moment(samples, modes.centres[0])[5, 5]) > 1.5


def test_what_may_stand_at_any_angle_is_one_mode() -> None:
    """A can spun through the whole circle: no mode is cut out of it, and the spread is the circle's."""
    angles = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    samples = poses_at(Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0]), np.zeros((90, 3)))

    modes = pose_modes(samples)

    assert modes.shares.tolist() == [1, 0, 0, 0]
    spread = np.sqrt(second_moment(samples, modes.centres[0])[5, 5])
    np.testing.assert_allclose(spread, np.pi / np.sqrt(3), rtol=0.02)


def test_the_mean_is_that_of_the_mode_and_long_chains_are_grouped_whole(seed: int) -> None:
    """More samples than are linked with each other; the mean lies within four standard errors."""
    count = 3 * LINKED
    places = np.random.default_rng(seed).normal(0.0, 0.002, (count, 3))
    places[: count // 4] += [0.0, 0.3, 0.0]
    turned = Rotation.from_rotvec([0, 0, np.pi])
    samples = poses_at(Rotation.concatenate([turned] * count), places)

    modes = pose_modes(samples)

    np.testing.assert_allclose(modes.shares[:2], [0.75, 0.25])
    np.testing.assert_allclose(modes.centres[0, :3, :3], turned.as_matrix(), atol=1e-9)
    near_mean = modes.centres[0, :3, 3]
    assert np.abs(near_mean).max() < 4 * 0.002 / np.sqrt(0.75 * LINKED)
