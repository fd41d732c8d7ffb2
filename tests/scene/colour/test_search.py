"""The search finds scenes at least as probable as the best of all scenes on a lattice."""

from itertools import combinations_with_replacement

import numpy as np
import pytest

from pipeline.synthesis.air import photograph
from scene.colour.density import Segments, laplace_evidence, sample
from scene.colour.kernels import log_gains
from scene.colour.lattice import Lattice, candidates, gains, surroundings
from scene.colour.posterior import (
    Scene,
    colour_image,
    log_likelihood,
    log_posterior,
    log_prior,
    visible,
    visible_gain,
)
from scene.colour.search import Searcher
from scene.colour.world import Layers
from tests.scene.colour.worlds import coloured_world, small_world

WORLD, COLOURED = small_world(), coloured_world()


def picture(rng: np.random.Generator, scene: Scene) -> np.ndarray:
    """Of things of strong colours, by Embree, silhouettes mixed."""
    albedo = rng.choice([0.1, 0.35, 1.0], (len(scene), 3))
    clean, _ = photograph(WORLD, scene, albedo)
    return np.clip(sample(rng, clean, WORLD.noise), 0, 1)


def lattice_posterior(image: np.ndarray, lattice: Lattice) -> dict[tuple[int, ...], float]:
    """Log posterior of every scene of up to two states, repeats allowed."""
    view = colour_image(WORLD, image)
    states = range(len(lattice.kinds))
    found: dict[tuple[int, ...], float] = {(): log_posterior(WORLD, view, Scene.empty())}
    singles = visible_gain(WORLD, view, lattice.layers)
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
        seen = visible(WORLD, layers, np.repeat(np.arange(len(part)), 2))
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
    lattice = Lattice.of(WORLD, spacing_m=0.07, yaws=6)
    truth = Scene(np.arange(things), np.array([[-0.06, 0.03, 0.4], [0.05, -0.02, 0.0]])[:things])
    image = picture(rng, truth)
    every = lattice_posterior(image, lattice)
    best = max(every, key=lambda scene: every[scene])
    found = Searcher.of(WORLD).find(image)

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
    found = Searcher.of(WORLD).find(image)
    true_density = log_posterior(WORLD, colour_image(WORLD, image), truth)

    assert found.best.log_density >= true_density - 2
    assert sorted(found.best.scene.kinds.tolist()) == [0, 1]


def test_gains_of_first_things_are_laplaces_of_the_exact_ones(seed: int) -> None:
    """Within a nat where the thing explains its pixels, and the best candidate is the lattice's best."""
    rng = np.random.default_rng(seed)
    lattice = Lattice.of(WORLD)
    image = colour_image(WORLD, picture(rng, Scene(np.array([0]), np.array([[0.01, 0.03, 0.1]]))))
    rest = surroundings(WORLD, image, Scene.empty())
    state = candidates(WORLD, image, rest, lattice, 1)[0]
    gain = gains(WORLD, image, rest, lattice.layers)
    exact = log_likelihood(WORLD, image, _scene(lattice, (state,)))

    assert gain.argmax() == state
    assert exact == pytest.approx(gain[state], abs=1)


def test_equal_images_give_equal_scenes(seed: int) -> None:
    """Nothing is drawn: the same bytes again."""
    image = picture(np.random.default_rng(seed), Scene(np.array([1]), np.array([[0.0, 0.0, 0.0]])))
    searcher = Searcher.of(WORLD)
    first, second = searcher.find(image), searcher.find(image)

    assert first.best.scene.poses.tobytes() == second.best.scene.poses.tobytes()
    assert first.count.tobytes() == second.count.tobytes()


@pytest.mark.parametrize("is_known", [False, True])
def test_gains_bound_what_was_clipped(seed: int, is_known: bool) -> None:
    """As Laplace's evidence of the same pixels, two too bright and one too dark, within half a nat."""
    world = COLOURED if is_known else WORLD
    rng = np.random.default_rng(seed)
    shade = rng.uniform(0.5, 1, 40)
    light = np.array([0.9, 0.6, 0.3])
    face = rng.integers(len(world.kinds[0].faces), size=40)
    lit = shade[:, None] * world.face_colours(3)[face]
    colour = (lit if is_known else lit * light) + world.noise.sigma * rng.standard_normal((40, 3))
    colour[:2, 0], colour[2, 2] = np.inf, -np.inf
    layers = Layers(np.array([0, 40]), np.arange(40), np.ones(40), shade, face, np.array([0]))
    gain = log_gains(world, colour, np.zeros(40), np.full(40, np.inf), layers)
    exact, _ = laplace_evidence(Segments(layers.start, colour, lit, np.array([is_known])), world.noise)
    assert gain == pytest.approx(exact, abs=0.5)
