"""Chains carry the objects that were found, and what they say is told of all objects again."""

from dataclasses import replace

import numpy as np
import pytest

from scene.objects.slots import SLOTS, FoundObjects
from scene.search.search_result import BoltzmannAtoms, Initialisation


def beginning(found: np.ndarray, rng: np.random.Generator) -> Initialisation:
    """A best scene in which these (N,) were found."""
    count = len(found)
    return Initialisation(
        poses=rng.normal(size=(count, 7)),
        found=found,
        rivals=rng.normal(size=(count, 7)),
        pools=rng.normal(size=(count, 4, 7)),
        log_gains=rng.normal(size=(count, 5)),
        log_alone=rng.normal(size=(count, 5)),
    )


@pytest.mark.parametrize("count", [1, 4, 21, 40])
def test_values_return_to_their_objects(count: int, seed: int) -> None:
    """Poses and parents by slot are those of the objects that were found; the others keep what they had."""
    rng = np.random.default_rng(seed)
    start = beginning(rng.random(count) < 0.5, rng)
    some = FoundObjects.of(start.found)

    theirs = start.of_slots(some)

    indices = np.flatnonzero(start.found)
    assert len(theirs.poses) == len(some.taken(range(count))) == some.slots >= max(len(indices), 1)
    assert theirs.found.sum() == len(indices)
    elsewhere = rng.normal(size=(1, count, 7))
    everywhere = some.spread(theirs.poses[None], elsewhere)[0]
    np.testing.assert_array_equal(everywhere, np.where(start.found[:, None], start.poses, elsewhere[0]))
    table, slots = some.slots, np.arange(len(indices))
    np.testing.assert_array_equal(some.parents(slots), indices)
    np.testing.assert_array_equal(some.parents(np.array([table, table + 2, -1])), [count, count + 2, -1])


def test_few_sizes_are_compiled() -> None:
    """Any number of objects found leads to one of few sizes, at most half as large again."""
    sizes = {count: FoundObjects.of(np.ones(count, bool)).slots for count in range(1, 55)}

    assert set(sizes.values()) == {*SLOTS, 2 * SLOTS[-1]}
    assert all(count <= size <= max(1.7 * count, count + 1) for count, size in sizes.items() if count <= 27)


def test_what_has_moved_is_offered_its_new_place_alone(seed: int) -> None:
    """The others keep their pools and atoms; what was not found has no pose of the new scene."""
    rng = np.random.default_rng(seed)
    atoms = BoltzmannAtoms(
        poses=rng.normal(size=(3, 5, 7)), log_weights=np.log(np.full((3, 5), 0.2)), pitch_m=0.01
    )
    start = replace(beginning(np.array([True, True, False]), rng), atoms=atoms)
    poses = rng.normal(size=(3, 7))

    told = start.with_scene(np.array([True, True, False]), poses, np.array([True, False, False]))

    np.testing.assert_array_equal(told.poses, [poses[0], poses[1], start.poses[2]])
    np.testing.assert_array_equal(told.pools[0], np.tile(poses[0], (4, 1)))
    np.testing.assert_array_equal(told.pools[1:], start.pools[1:])
    np.testing.assert_array_equal(told.log_gains[0], [0, 0, 0, 0, start.log_gains[0, 4]])
    np.testing.assert_array_equal(told.log_gains[1:], start.log_gains[1:])
    assert told.atoms is not None
    assert np.isneginf(told.atoms.log_weights[0]).all()
    np.testing.assert_array_equal(told.atoms.log_weights[1:], atoms.log_weights[1:])
