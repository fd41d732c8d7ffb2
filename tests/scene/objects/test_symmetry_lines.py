"""The lines about which parts of a turn leave a surface nearly as it is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from scene.mcmc.symmetry_arrays import Symmetries, symmetry_angle
from scene.objects.scene_object import SceneObject, scene_object
from tests.statistical import assert_mean

SQUARE = (0.06, 0.06, 0.15)
KNOB_M = 0.01


def boxes(*parts: tuple[tuple[float, float, float], tuple[float, float, float]]) -> trimesh.Trimesh:
    """Boxes of these extents with these middles, as one mesh, turned and moved."""
    meshes = []
    for extents, middle in parts:
        meshes.append(trimesh.creation.box(extents))
        meshes[-1].apply_translation(middle)
    whole = trimesh.util.concatenate(meshes)
    assert isinstance(whole, trimesh.Trimesh)
    return whole


def turned(mesh: trimesh.Trimesh, turn: Rotation, shift: np.ndarray) -> SceneObject:
    """The object of a mesh elsewhere."""
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = turn.as_matrix(), shift
    mesh.apply_transform(placed)
    return scene_object("box", mesh.vertices, mesh.faces)


def test_a_box_with_a_knob_turns_about_the_middle_of_the_box(seed: int) -> None:
    """Not of what bounds both, 5 mm beside it: lines lie within 0.3 mm and half a degree."""
    knob = ((KNOB_M, KNOB_M, KNOB_M), (0.0, 0.0, 0.075 + KNOB_M / 2))
    turn, shift = Rotation.random(rng=np.random.default_rng(seed)), np.array([0.3, -0.2, 0.1])

    one = turned(boxes((SQUARE, (0.0, 0.0, 0.0)), knob), turn, shift)

    assert sorted(one.symmetry_orders) == [2, 2, 4]
    lines = one.symmetry_lines @ np.linalg.inv(one.box_from_object)[:3, :3].T
    for (direction, point), order in zip(lines, one.symmetry_orders, strict=True):
        along = np.abs(turn.inv().apply(direction))
        assert along.max() > np.cos(np.radians(0.5))
        assert (along.argmax() == 2) == (order == 4)
        off = one.centre_m + point - shift
        assert np.linalg.norm(off - off @ direction * direction) < 0.0003


@pytest.mark.parametrize(
    ("extents", "orders"), [((0.05, 0.08, 0.15), [2, 2, 2]), ((0.07, 0.07, 0.07), [4, 4, 4])]
)
def test_a_box_has_the_turns_of_its_sides(extents: tuple[float, float, float], orders: list[int]) -> None:
    """Half ones, and quarters of a cube."""
    one = turned(boxes((extents, (0.0, 0.0, 0.0))), Rotation.identity(), np.zeros(3))
    assert sorted(one.symmetry_orders) == orders


def test_an_l_has_no_line() -> None:
    """Of unequal legs: no part of a turn repeats it."""
    mesh = boxes(((0.04, 0.04, 0.2), (0.0, 0.0, 0.0)), ((0.12, 0.04, 0.04), (0.08, 0.0, -0.08)))
    assert not turned(mesh, Rotation.identity(), np.zeros(3)).symmetry_orders.any()


def test_turns_are_drawn_as_often_either_way(key: jax.Array) -> None:
    """Half of them stay; of order 4 an eighth is a quarter each way: within 1e-6 false alarms."""
    angles = symmetry_angle(jnp.array(4), jax.random.normal(key, (100_000,)))
    quarters = np.asarray(angles / (jnp.pi / 2))
    kinds = np.stack([quarters == 0, quarters == 1, quarters == -1, quarters == 2], axis=1).astype(float)
    assert_mean(kinds, np.array([0.5, 0.125, 0.125, 0.25]), detectable=0.02)
    assert set(np.unique(symmetry_angle(jnp.array(2), jnp.array([0.1, -0.9, 2.0])))) == {
        0.0,
        float(jnp.pi),
    }


def test_a_body_without_lines_does_not_turn() -> None:
    """Its order is 0, and no angle is drawn."""
    order = Symmetries.of([], 2).drawn(jnp.array(1), jnp.array(0.7))[2]
    assert not np.asarray(symmetry_angle(order, jnp.array([-3.0, 0.0, 1.0]))).any()
