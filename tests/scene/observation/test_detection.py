"""The support plane is found where it is, whatever stands on it and however the camera bends it."""

import numpy as np
import pytest

from scene.observation.detection import SupportPlane, as_seen, clusters, support_planes

CAMERA_FROM_TABLE = np.array([[1, 0, 0, 0.02], [0, -0.8, -0.6, 0.1], [0, 0.6, -0.8, 0.9], [0, 0, 0, 1.0]])


def in_camera(points: np.ndarray) -> np.ndarray:
    """Points (N, 3) of the table's frame in the camera's."""
    return points @ CAMERA_FROM_TABLE[:3, :3].T + CAMERA_FROM_TABLE[:3, 3]


def surface(rng: np.random.Generator, bend_m: float) -> np.ndarray:
    """A table of 80 x 60 cm in its own frame, its corners `bend_m` higher than its middle."""
    points = rng.uniform([-0.4, -0.3, 0], [0.4, 0.3, 0], (20_000, 3))
    points[:, 2] = bend_m * ((points[:, 0] / 0.4) ** 2 + (points[:, 1] / 0.3) ** 2) / 2
    return points + rng.normal(0, 0.001, points.shape)


@pytest.mark.parametrize("bend_m", [0.0, 0.01])
def test_heights_over_the_seen_table(seed: int, bend_m: float) -> None:
    """The table at height 0, a block on it at its own, to 2 mm; normal towards the camera."""
    rng = np.random.default_rng(seed)
    block = rng.uniform([-0.05, -0.05, 0.1], [0.05, 0.05, 0.1], (1500, 3))
    floor = rng.uniform([-1, -1, -0.7], [1, 1, -0.7], (8000, 3))
    flat = surface(rng, bend_m)
    table, *_ = support_planes(in_camera(np.concatenate([flat, block, floor])), 1, lambda _: True)
    assert np.abs(table.heights(in_camera(flat))).max() < 0.002 + 4 * 0.001
    assert abs(np.median(table.heights(in_camera(block))) - 0.1) < 0.002
    np.testing.assert_allclose(table.camera_from_table[:3, 2], CAMERA_FROM_TABLE[:3, 2], atol=0.02)
    np.testing.assert_allclose(table.half_size_m, [0.4, 0.3], atol=0.02)


def test_another_rectangle_is_of_the_same_surface(seed: int) -> None:
    """Heights over a bent table are the same in the frame of a larger rectangle round another middle."""
    rng = np.random.default_rng(seed)
    bent = SupportPlane(
        camera_from_table=CAMERA_FROM_TABLE,
        half_size_m=np.array([0.4, 0.3]),
        bend=rng.normal(0, 0.01, 6),
    )
    wider = bent.spanning(np.array([-0.4, -0.5]), np.array([0.7, 0.3]))
    points = in_camera(rng.uniform([-0.4, -0.3, -0.1], [0.4, 0.3, 0.3], (100, 3)))
    np.testing.assert_allclose(wider.heights(points), bent.heights(points), atol=1e-12)
    np.testing.assert_allclose(wider.half_size_m, [0.55, 0.4])


@pytest.mark.parametrize("seed", range(4))
def test_a_view_of_a_corner_leaves_the_rest_flat(seed: int) -> None:
    """A corner of 15 x 10 cm, bent as cameras do at .9 m: there to 3 mm, elsewhere to 3 sd of the prior."""
    rng = np.random.default_rng(seed)
    whole = SupportPlane(
        camera_from_table=CAMERA_FROM_TABLE, half_size_m=np.array([0.4, 0.3]), bend=np.zeros(6)
    )
    flat = surface(rng, 0.008)
    corner = flat[(flat[:, 0] > 0.25) & (flat[:, 1] > 0.2)] + rng.normal(0, 0.002, 3) * [0, 0, 1]
    shown = as_seen(whole, in_camera(corner))
    assert np.abs(shown.heights(in_camera(corner))).max() < 0.003 + 4 * 0.001
    assert np.abs(shown.heights(in_camera(flat))).max() < 0.024


def test_what_hides_a_table_does_not_part_it(seed: int) -> None:
    """A fence across the table hides a band of it wider than a gap between two tables; both sides are one."""
    rng = np.random.default_rng(seed)
    flat = surface(rng, 0.0)
    eye = -CAMERA_FROM_TABLE[:3, :3].T @ CAMERA_FROM_TABLE[:3, 3]
    crossing = eye + (flat - eye) * (eye[1] / (eye[1] - flat[:, 1]))[:, None]
    between = (eye[1] > 0) != (flat[:, 1] > 0)
    hidden = between & (crossing[:, 2] < 0.12)
    assert np.ptp(flat[hidden, 1]) > 0.07
    fence = rng.uniform([-0.4, 0, 0], [0.4, 0, 0.12], (6000, 3))
    table, *_ = support_planes(in_camera(np.concatenate([flat[~hidden], fence])), 1, lambda _: True)
    np.testing.assert_allclose(table.half_size_m, [0.4, 0.3], atol=0.02)


def test_faces_of_several_objects_are_no_table(seed: int) -> None:
    """Squares of 10 cm in one plane, with things before the gaps between them: too narrow to stand on."""
    rng = np.random.default_rng(seed)
    plane = np.append(rng.uniform(-0.35, 0.35, (30_000, 2)), np.zeros((30_000, 1)), axis=1)
    on_face = (np.mod(plane[:, :2] + 0.05, 0.2) < 0.1).all(axis=1)
    eye = -CAMERA_FROM_TABLE[:3, :3].T @ CAMERA_FROM_TABLE[:3, 3]
    gaps = plane[~on_face][:2000]
    before = eye + (gaps - eye) * (1 - rng.uniform(0.05, 0.3, (len(gaps), 1)) / eye[2])
    assert not support_planes(in_camera(np.concatenate([plane[on_face], before])), 1, lambda _: True)


@pytest.mark.parametrize("seed", range(2))
def test_strays_in_a_plane_come_in_pieces_of_two(seed: int) -> None:
    """Sparse points all round at a table's height, of which a neighbouring piece leaves some two or one."""
    rng = np.random.default_rng(seed)
    flat, strays = surface(rng, 0.0)[:7000], rng.uniform([-2, -2, 0], [2, 2, 0], (13_000, 3))
    block = rng.uniform([-0.05, -0.05, 0.1], [0.05, 0.05, 0.1], (1500, 3))
    table, *_ = support_planes(in_camera(np.concatenate([flat, strays, block])), 1, lambda _: True)
    assert abs(np.median(table.heights(in_camera(flat)))) < 0.001


def test_a_cloud_without_anything_on_a_plane_has_no_table(seed: int) -> None:
    """A bare wall supports nothing."""
    wall = np.random.default_rng(seed).uniform([-1, -1, 2], [1, 1, 2], (5000, 3))
    assert not support_planes(wall, 1, lambda _: True)


def test_clusters_come_apart_at_the_finer_scale(seed: int) -> None:
    """Two balls 3 cm apart are two clusters at 1 cm and one at 4 cm, the larger first."""
    rng = np.random.default_rng(seed)
    balls = rng.uniform(-0.02, 0.02, (2, 400, 3))
    balls[1, :, 0] += 0.07
    centres = clusters(balls.reshape(-1, 3), (0.01, 0.04))
    np.testing.assert_allclose(centres[0], [0.035, 0, 0], atol=0.003)
    np.testing.assert_allclose(np.sort(centres[:, 0]), [0.0, 0.035, 0.07], atol=0.003)


def test_all_that_can_carry_is_found_the_one_that_carries_most_first(seed: int) -> None:
    """Two tops of 50 x 40 cm, 12 cm apart in height, over a floor, and a wall; a block on the lower one."""
    rng = np.random.default_rng(seed)
    low = rng.uniform([-0.6, -0.2, 0], [-0.1, 0.2, 0], (8000, 3))
    high = rng.uniform([0.1, -0.2, 0.12], [0.6, 0.2, 0.12], (8000, 3))
    floor = rng.uniform([-1, -1, -0.7], [1, 1, -0.7], (10_000, 3))
    wall = rng.uniform([-1, 1, -0.7], [1, 1, 1], (6000, 3))
    block = rng.uniform([-0.4, -0.05, 0.0], [-0.3, 0.05, 0.1], (4000, 3))
    points = np.concatenate([low, high, floor, wall, block])

    table, *others = support_planes(in_camera(points), 1, lambda _: True)

    assert abs(np.median(table.heights(in_camera(low)))) < 0.002
    heights = sorted(float(np.median(one.heights(in_camera(low)))) for one in others)
    np.testing.assert_allclose(heights, [-0.12, 0.7], atol=0.005)
