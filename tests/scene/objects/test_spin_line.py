"""The line about which most of a shape is round, and turns about it."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from scene.objects.scene_object import scene_object
from scene.objects.symmetry import APART, better_restarts, symmetric_restarts

RADIUS_M, HEIGHT_M = 0.04, 0.09


def mug() -> trimesh.Trimesh:
    """A cylinder with a handle on the side of +x."""
    handle = trimesh.creation.box((0.03, 0.012, 0.06))
    handle.apply_translation((RADIUS_M + 0.012, 0, 0))
    body = trimesh.creation.cylinder(radius=RADIUS_M, height=HEIGHT_M, sections=64)
    both = trimesh.util.concatenate([body, handle])
    assert isinstance(both, trimesh.Trimesh)
    return both


def test_a_mug_spins_about_the_axis_of_its_body(seed: int) -> None:
    """Wherever its frame is: within 1 degree and 0.5 mm, though the handle moves the box's middle."""
    mesh = mug()
    turn = Rotation.random(rng=np.random.default_rng(seed))
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = turn.as_matrix(), (0.3, -0.2, 0.1)
    mesh.apply_transform(placed)

    one = scene_object("mug", mesh.vertices, mesh.faces)

    object_from_box = np.linalg.inv(one.box_from_object)
    direction, point = one.spin_line @ object_from_box[:3, :3].T
    assert abs(direction @ turn.apply([0, 0, 1])) > np.cos(np.radians(1))
    off = one.centre_m + point - placed[:3, 3]
    assert np.linalg.norm(off - off @ direction * direction) < 0.0005
    assert not one.spins_freely


@pytest.mark.parametrize("axes", [[0, 1, 2, 3], [1, 2, 0, 3]])
def test_a_can_spins_freely(axes: list[int]) -> None:
    """Whichever its axis is."""
    mesh = trimesh.creation.cylinder(0.03, 0.1, transform=np.eye(4)[axes])
    assert scene_object("can", mesh.vertices, mesh.faces).spins_freely


@pytest.mark.parametrize("extents", [(0.1, 0.1, 0.2), (0.1, 0.1, 0.02), (0.05, 0.06, 0.07)])
def test_a_box_spins_about_nothing(extents: tuple[float, float, float]) -> None:
    """Not even a square one, nor a flat one, whose large faces any turn leaves in place."""
    mesh = trimesh.creation.box(extents)
    assert not scene_object("box", mesh.vertices, mesh.faces).spin_line.any()


def test_a_spin_leaves_the_line_where_it_is(seed: int) -> None:
    """Points of the line stay, and a point beside it comes back after a whole turn."""
    rng = np.random.default_rng(seed)
    poses = np.concatenate(
        [Rotation.random(3, rng=rng).as_quat()[:, [3, 0, 1, 2]], rng.normal(size=(3, 3))], axis=1
    )
    lines = rng.normal(size=(3, 2, 3))
    lines[:, 0] /= np.linalg.norm(lines[:, 0], axis=1, keepdims=True)

    turned = symmetric_restarts(poses, lines, 8)

    def seen(point: np.ndarray, one: int) -> np.ndarray:
        return Rotation.from_quat(turned[one][:, [1, 2, 3, 0]]).apply(point) + turned[one][:, 4:]

    for one, (direction, point) in enumerate(lines):
        for along in (0.0, 0.7):
            places = seen(point + along * direction, one)
            np.testing.assert_allclose(places, np.repeat(places[:1], 8, axis=0), atol=1e-12)
        beside = seen(point + np.cross(direction, [1.0, 2.0, 3.0]), one)
        middle = seen(point, one)[0]
        np.testing.assert_allclose(beside[0] + beside[4], 2 * middle, atol=1e-12)
        np.testing.assert_allclose(beside[1] + beside[5], 2 * middle, atol=1e-12)
        assert np.linalg.norm(beside[0] - beside[1]) > 0.1


def test_the_best_turns_are_apart_and_better_than_none() -> None:
    """Two peaks of three, neither their flanks nor the first turn's; none where the first is the best."""
    places = np.arange(96)
    apart = int(np.ceil(APART / (2 * np.pi) * 96))
    close = apart - 1

    def peak(place: int, height: float) -> np.ndarray:
        steps = np.abs(places - place)
        return height - np.minimum(steps, 96 - steps)

    peaks = peak(0, 5.0), peak(60, 30.0)
    assert better_restarts(np.max([*peaks, peak(30, 20.0), peak(96 - apart, 25.0)], axis=0)) == [
        60,
        96 - apart,
    ]
    assert better_restarts(np.max([*peaks, peak(30, 5.5), peak(96 - close, 6.0)], axis=0)) == [60, 30]
    assert better_restarts(np.max([peak(0, 5.0), peak(30, 20.0)], axis=0))[0] == 30
    assert better_restarts(-np.abs(places - 0.0)) == []
