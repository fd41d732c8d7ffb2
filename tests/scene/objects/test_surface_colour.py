"""Colours along surfaces, and the turns that depth cannot tell."""

from functools import cache

import numpy as np
import pytest
import trimesh

from pipeline.meshes import vertex_rgb
from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.paint import painted
from scene.objects.scene_object import SceneObject, scene_object
from scene.objects.surface_colour import SPINS, components_of_light


@cache
def bare(name: str) -> SceneObject:
    """A built-in object without colours."""
    mesh = built_in_object(name)
    return scene_object(name, np.asarray(mesh.vertices), np.asarray(mesh.faces))


def coloured(name: str, pattern: str = "halves") -> tuple[SceneObject, trimesh.Trimesh]:
    """A built-in object with a pattern, and its mesh."""
    mesh = painted(name, built_in_object(name), pattern)
    rgb = vertex_rgb(mesh)
    return bare(name).coloured(np.asarray(mesh.vertices), np.asarray(mesh.faces), rgb, 2.2), mesh


@pytest.mark.parametrize(
    ("name", "turns", "spins"), [("can", SPINS, True), ("box", 4, False), ("mug", 1, False)]
)
def test_turns_are_those_that_leave_the_shape(name: str, turns: int, spins: bool) -> None:
    """A can spins, a box lies four ways, a mug's handle tells; the first turn is none."""
    colour = coloured(name)[0].colour
    assert colour is not None
    assert len(colour.turns) in (turns, 2 * turns if spins else turns)
    assert colour.spins == spins
    assert np.array_equal(colour.turns[0], np.eye(4))


def test_colours_are_those_beside() -> None:
    """Of points on the surface, away from where colours meet: the vertices' own, to a tenth of the light."""
    one, mesh = coloured("box")
    assert one.colour is not None
    points, places = map(np.asarray, trimesh.sample.sample_surface(mesh, 500, seed=1)[:2])
    painted_rgb = vertex_rgb(mesh)
    assert painted_rgb is not None
    far = np.abs(points[:, 1]) > 0.012
    in_box = points @ one.box_from_object[:3, :3].T + one.box_from_object[:3, 3]
    cell = ((in_box - one.colour.origin_m) / one.colour.pitch_m).astype(int)
    shown = one.colour.values[tuple(cell.T)]
    rgb = painted_rgb[mesh.faces[places][:, 0]]
    assert np.abs(shown - components_of_light((rgb / 255) ** 2.2))[far].max() < 0.1
    assert far.sum() > 300


@pytest.mark.parametrize(("pattern", "looks"), [("plain", 1), ("stripes", 2), ("label", 2 * SPINS)])
def test_looks_are_what_colours_tell_of_turns(pattern: str, looks: int) -> None:
    """Nothing of a plain can, which end is up of one with stripes, all of a label."""
    colour = coloured("can", pattern)[0].colour
    assert colour is not None
    assert colour.spins
    assert colour.exact
    assert len(colour.looks) == looks


def test_an_unknown_colour_turns_nothing() -> None:
    """One albedo that nobody knows tells no turn from another."""
    mesh = built_in_object("can")
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    colour = bare("can").coloured(vertices, faces, None, 2.2).colour
    assert colour is not None
    assert not colour.is_known
    assert len(colour.turns) == 1
