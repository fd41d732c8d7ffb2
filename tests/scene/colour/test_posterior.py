"""The exact posterior of scenes: its prior, its overlap rule, its visible pixels."""

import numpy as np
import pytest

from scene.colour.posterior import (
    OVERLAP_M,
    Scene,
    colour_image,
    log_likelihood,
    log_posterior,
    log_prior,
    overlapping,
)
from tests.scene.colour.worlds import small_world

WORLD = small_world()


def scene(*things: tuple[int, float, float, float]) -> Scene:
    """Of (kind, x, y, yaw)."""
    return Scene(np.array([one[0] for one in things]), np.array([one[1:] for one in things]).reshape(-1, 3))


def test_the_prior_of_each_number_integrates_to_its_probability() -> None:
    """Over kinds, places and yaws, unordered, before the overlap rule: 1 / (most + 1) each."""
    side, turn = 2 * WORLD.half_m, 2 * np.pi
    box, disc = (0, -0.1, 0, 0), (1, 0.1, 0, 0)
    one = (
        np.exp(log_prior(WORLD, scene(box))) * side**2 * turn
        + np.exp(log_prior(WORLD, scene(disc))) * side**2
    )
    far = (
        [(0, -0.1, 0, 0), (0, 0.1, 0, 0)],
        [(0, -0.1, 0, 0), (1, 0.1, 0, 0)],
        [(1, -0.1, 0, 0), (1, 0.1, 0, 0)],
    )
    two_boxes, both, two_discs = (np.exp(log_prior(WORLD, scene(*things))) for things in far)
    pairs = (two_boxes * turn**2 / 2 + both * turn + two_discs / 2) * side**4

    assert np.exp(log_prior(WORLD, Scene.empty())) == pytest.approx(1 / 3)
    assert one == pytest.approx(1 / 3)
    assert pairs == pytest.approx(1 / 3)


def test_boxes_may_touch_but_not_overlap() -> None:
    """By more than 2 mm along every axis that could part them, turned ones too; off the square is nowhere."""
    reach = 0.045 + 0.045
    assert not overlapping(WORLD, scene((0, 0, 0, 0), (0, reach - 0.9 * OVERLAP_M, 0, 0))).any()
    assert overlapping(WORLD, scene((0, 0, 0, 0), (0, reach - 1.1 * OVERLAP_M, 0, 0))).all(
        where=~np.eye(2, dtype=bool)
    )
    assert not overlapping(WORLD, scene((0, 0, 0, 0), (0, 0.0, 0.048 + 0.001, 0))).any()
    assert overlapping(WORLD, scene((0, 0, 0, 0), (0, 0.0, 0.049, np.pi / 2))).any()
    diagonal = (0.045 + 0.025) / np.sqrt(2)
    assert not overlapping(WORLD, scene((0, 0, 0, np.pi / 4), (0, diagonal, diagonal, 3 * np.pi / 4))).any()
    assert log_prior(WORLD, scene((1, 0.141, 0, 0))) == -np.inf
    assert log_prior(WORLD, scene(*[(1, x, 0, 0) for x in (-0.1, 0, 0.1)])) == -np.inf


def test_what_is_hidden_leaves_the_likelihood_alone(seed: int) -> None:
    """A thing behind another, pixel for pixel, adds nothing but its prior; order means nothing."""
    rng = np.random.default_rng(seed)
    image = colour_image(WORLD, rng.uniform(size=(24, 24, 3)))
    two = scene((0, -0.06, 0, 0.3), (1, 0.05, 0.02, 0))
    other = scene((1, 0.05, 0.02, 0), (0, -0.06, 0, 0.3))

    assert log_posterior(WORLD, image, two) == pytest.approx(log_posterior(WORLD, image, other))
    apart = [log_likelihood(WORLD, image, two.without(one)) for one in (0, 1)]
    assert log_likelihood(WORLD, image, two) == pytest.approx(sum(apart))
    assert log_likelihood(WORLD, image, Scene.empty()) == 0


def test_an_image_of_another_size_is_refused() -> None:
    """In one line that names both."""
    with pytest.raises(ValueError, match="the image is 20x24, the camera 24x24"):
        colour_image(WORLD, np.zeros((24, 20, 3)))
