"""The search finds scenes at least as probable as the best of all scenes on a lattice."""

from dataclasses import replace
from itertools import combinations_with_replacement, pairwise

import numpy as np
import pytest
import trimesh

from pipeline.synthesis.air import photograph
from scene.colour.density import sample
from scene.colour.lattice import Lattice, candidates
from scene.colour.posterior import (
    Scene,
    colour_image,
    log_likelihood,
    log_posterior,
    log_prior,
    seen_together,
    visible_gain,
)
from scene.colour.refinement import refine
from scene.colour.search import find
from scene.colour.surroundings import Surroundings
from scene.colour.world import Kind, TableWorld
from tests.scene.colour.worlds import small_world

WORLD = small_world()


def picture(rng: np.random.Generator, scene: Scene, world: TableWorld = WORLD) -> np.ndarray:
    """Of things of strong colours, by Embree, silhouettes mixed."""
    albedo = rng.choice([0.1, 0.35, 1.0], (len(scene), 3))
    clean, _ = photograph(world, scene, albedo)
    return np.clip(sample(rng, clean, world.noise), 0, 1)


def test_states_that_cover_no_pixel_have_no_area() -> None:
    """Of a thing smaller than a pixel most places show nothing, the last one too."""
    crumb = Kind.standing("crumb", trimesh.creation.box((0.004, 0.004, 0.004)))
    lattice = Lattice.of(replace(WORLD, kinds=(crumb,)))
    start = lattice.layers.start
    expected = [(lattice.layers.fill[one:end] ** 2).sum() for one, end in pairwise(start)]
    assert start[-2] == start[-1] > 0
    np.testing.assert_allclose(lattice.areas, expected, rtol=1e-6)


def lattice_posterior(image: np.ndarray, lattice: Lattice) -> dict[tuple[int, ...], float]:
    """Log posterior of every scene of up to two states, repeats allowed."""
    view = colour_image(WORLD, image)
    states = range(len(lattice.kinds))
    found: dict[tuple[int, ...], float] = {(): log_posterior(WORLD, view, Scene.empty())}
    singles = visible_gain(WORLD, view, seen_together(WORLD, lattice.layers, np.arange(len(lattice.kinds))))
    for one in states:
        found[one,] = log_prior(WORLD, _scene(lattice, (one,))) + singles[one]
    pairs = [
        pair
        for pair in combinations_with_replacement(states, 2)
        if np.isfinite(log_prior(WORLD, _scene(lattice, pair)))
    ]
    for start in range(0, len(pairs), 500):
        part = np.array(pairs[start : start + 500])
        layers = lattice.layers.of(part.ravel())
        seen = seen_together(WORLD, layers, np.repeat(np.arange(len(part)), 2))
        gain = visible_gain(WORLD, view, seen).reshape(-1, 2).sum(axis=1)
        for pair, value in zip(part.tolist(), gain, strict=True):
            found[tuple(pair)] = log_prior(WORLD, _scene(lattice, pair)) + value
    return found


def _scene(lattice: Lattice, states: tuple[int, ...]) -> Scene:
    return Scene(lattice.kinds[list(states)], lattice.poses[list(states)])


@pytest.mark.parametrize("things", [1, 2])
def test_no_scene_of_a_lattice_is_more_probable_than_what_is_found(seed: int, things: int) -> None:
    """All scenes of up to two of 64 states are summed over; the search moves off the lattice."""
    rng = np.random.default_rng(seed)
    coarse = Lattice.of(WORLD, spacing_m=0.07, yaws=6)
    lattice = Lattice.rendered(WORLD, coarse.kinds, coarse.poses, coarse.groups)
    truth = Scene(np.arange(things), np.array([[-0.06, 0.03, 0.4], [0.05, -0.02, 0.0]])[:things])
    image = picture(rng, truth)
    every = lattice_posterior(image, lattice)
    best = max(every, key=lambda scene: every[scene])
    found = find(Lattice.of(WORLD), image)

    assert len(every) > 1000
    assert every[best] == pytest.approx(
        log_posterior(WORLD, colour_image(WORLD, image), _scene(lattice, best))
    )
    assert found.best.log_density >= every[best]
    assert found.count.argmax() == things
    assert found.best.scene.kinds.tolist() in ([*range(things)], [*range(things)][::-1])
    assert found.count.sum() == pytest.approx(1)


def test_hidden_and_touching_things_are_counted(seed: int) -> None:
    """Two of one colour side by side, one before the other: no single thing explains them."""
    rng = np.random.default_rng(seed)
    truth = Scene(np.array([0, 1]), np.array([[0.0, 0.05, 0.2], [0.01, -0.02, 0.0]]))
    clean, _ = photograph(WORLD, truth, np.tile([0.2, 0.3, 0.9], (2, 1)))
    image = np.clip(sample(rng, clean, WORLD.noise), 0, 1)
    found = find(Lattice.of(WORLD), image)
    true_density = log_posterior(WORLD, colour_image(WORLD, image), truth)

    assert found.best.log_density >= true_density - 2
    assert sorted(found.best.scene.kinds.tolist()) == [0, 1]


def test_refined_things_stand_where_the_density_is_greatest(seed: int) -> None:
    """From a lattice cell off; the exact gain agrees to a nat, and no pose nearby is better by two.

    Deviations by curvature are those along which the density falls by half a nat, within a third.
    """
    rng = np.random.default_rng(seed)
    world = small_world(48)
    truth = Scene(np.array([0]), np.array([[0.01, 0.03, 0.1]]))
    image = colour_image(world, picture(rng, truth, world))
    around = Surroundings.of(world, image, [Scene.empty()])
    starts = truth.poses + np.array([[0.008, -0.006, 0.2], [-0.007, 0.007, -0.2]])
    both = np.zeros(2, np.int64)
    found = refine(world, around, both, starts, both, both, 1)
    pose, sd = found.poses[0], np.sqrt(np.diag(found.covariance[0]))
    near = [Scene(truth.kinds, pose[None] + sd * step) for step in rng.normal(0, 1, (40, 3))]

    assert log_likelihood(world, image, Scene(truth.kinds, pose[None])) == pytest.approx(
        found.gains[0], abs=1
    )
    assert max(log_likelihood(world, image, one) for one in near) < found.gains[0] + 2
    assert (np.abs(pose - truth.poses[0]) < 5 * sd).all()


def test_the_best_of_a_lattice_are_candidates(seed: int) -> None:
    """The state nearest to the one thing there is the first."""
    rng = np.random.default_rng(seed)
    lattice = Lattice.of(WORLD)
    truth = Scene(np.array([0]), np.array([[0.01, 0.03, 0.0]]))
    around = Surroundings.of(WORLD, colour_image(WORLD, picture(rng, truth)), [Scene.empty()])
    first = candidates(lattice, around).states[0]
    apart = np.abs(lattice.poses[lattice.kinds == 0][:, :2] - truth.poses[0, :2]).max(axis=1)

    assert lattice.kinds[first] == 0
    assert np.abs(lattice.poses[first, :2] - truth.poses[0, :2]).max() == pytest.approx(
        apart.min(), abs=0.011
    )


def test_equal_images_give_equal_scenes(seed: int) -> None:
    """Nothing is drawn: the same bytes again."""
    image = picture(np.random.default_rng(seed), Scene(np.array([1]), np.array([[0.0, 0.0, 0.0]])))
    lattice = Lattice.of(WORLD)
    first, second = find(lattice, image), find(lattice, image)

    assert first.best.scene.poses.tobytes() == second.best.scene.poses.tobytes()
    assert first.count.tobytes() == second.count.tobytes()
