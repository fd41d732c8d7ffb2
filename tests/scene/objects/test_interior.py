"""How deep objects reach into each other, against solids of known form."""

import numpy as np
import pytest
import trimesh

from scene.objects.interior import Interior, penetrations_m
from scene.objects.scene_object import scene_object

SIZES_M = (0.2, 0.1, 0.06), (0.05, 0.05, 0.05)


def interior(mesh: trimesh.Trimesh) -> Interior:
    """Of an object with this surface."""
    return Interior.of(scene_object("it", np.asarray(mesh.vertices), np.asarray(mesh.faces)))


def at(positions_m: np.ndarray) -> np.ndarray:
    """Poses (S, 7) that are not turned."""
    return np.concatenate([np.tile([1.0, 0, 0, 0], (len(positions_m), 1)), positions_m], axis=1)


def test_depths_are_those_of_a_box(seed: int) -> None:
    """The distance to the nearest face, to half a voxel's diagonal; 0 outside, however far."""
    box = interior(trimesh.creation.box(SIZES_M[0]))
    axes_m = np.sort(SIZES_M[0])[::-1] / 2  # whatever way the box frame lies, each point is told by all faces
    points_m = np.random.default_rng(seed).uniform(-0.2, 0.2, (4000, 3))
    order = np.argsort(-np.ptp(box.points_m, axis=0))
    exact = (axes_m - np.abs(points_m[:, order])).min(axis=1).clip(0)

    told = box.depths_m(points_m)

    np.testing.assert_allclose(told, exact, atol=np.sqrt(3) / 2 * box.pitch_m + 1e-6)
    assert (told[exact == 0] <= np.sqrt(3) / 2 * box.pitch_m).all()
    assert (box.depths_m(np.array([[9.0, 0, 0], [0, -9.0, 0]])) == 0).all()


@pytest.mark.parametrize("swapped", [False, True])
def test_a_cube_that_sinks_into_a_box(swapped: bool) -> None:
    """Through its upper face: as deep as its lower face, whichever of the two is asked for."""
    box, cube = (interior(trimesh.creation.box(size)) for size in SIZES_M)
    thin = int(np.ptp(box.points_m, axis=0).argmin())
    sunk_m = np.array([-0.03, 0.0, 0.004, 0.01, 0.02])
    positions_m = np.zeros((5, 3))
    positions_m[:, thin] = 0.03 + 0.025 - sunk_m
    (origin,) = at(np.zeros((1, 3)))

    if swapped:
        told = penetrations_m(box, at(-positions_m), cube, origin)
    else:
        told = penetrations_m(cube, at(positions_m), box, origin)

    np.testing.assert_allclose(told, sunk_m.clip(0), atol=box.pitch_m + cube.pitch_m)


def test_what_stands_in_a_cup_is_outside_of_it() -> None:
    """A stick in a cup that is open above touches nothing; through its wall it does."""
    cup = trimesh.creation.annulus(r_min=0.035, r_max=0.04, height=0.1)
    stick = trimesh.creation.cylinder(radius=0.005, height=0.15)
    cup, stick = interior(cup), interior(stick)
    axis, along = (int(np.ptp(one.points_m, axis=0).argmax()) for one in (cup, stick))
    assert axis == along  # box frames follow the longest edge
    aside = np.zeros((1, 3))
    aside[0, (axis + 1) % 3] = 0.0375

    (origin,) = at(np.zeros((1, 3)))
    inside = penetrations_m(stick, origin[None], cup, origin)
    through = penetrations_m(stick, at(aside), cup, origin)

    assert inside[0] == 0
    assert through[0] > 0.001
