"""Mixtures on poses and sizes: the density is that of the draws, and sizes have the prior that is told."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from scene.likelihood.pixel_density import SUPPORT_ERROR
from scene.objects.scene_object import scene_object
from scene.presence.size_prior import SizePrior
from scene.presence.state_mixture import StateMixture
from tests.statistical import assert_mean

BOX, CAN = np.arange(3), np.array([0, 0, 2])
"""Ties of sizes: a box's are its own, a can has one radius."""


def mixture(rng: np.random.Generator, ties: np.ndarray) -> StateMixture:
    """Three components of one object; its point lies outside its box."""
    turns = Rotation.random(3, rng=rng).as_quat(scalar_first=True)
    places, sizes = rng.normal(0, 0.02, (3, 3)), rng.normal(math.log(0.05), 0.02, (3, 3))[:, ties]
    factors = 0.3 * np.tril(rng.normal(0, 0.02, (3, 9, 9))) + np.diag([0.02] * 3 + [0.3] * 3 + [0.03] * 3)
    fixed = 6 + np.flatnonzero(ties != np.arange(3))
    factors[:, fixed], factors[:, :, fixed] = 0.0, 0.0
    factors[:, fixed, fixed] = 1.0
    return StateMixture(
        log_weights=np.log([[0.5, 0.3, 0.2]]),
        centres=np.concatenate([turns, places, sizes], axis=1)[None],
        factors=factors[None],
        points_m=np.array([[0.1, -0.05, 0.02]]),
        ties=ties[None],
    )


@pytest.mark.parametrize("ties", [BOX, CAN])
def test_the_density_is_that_of_the_draws(ties: np.ndarray, seed: int) -> None:
    """The ratio of a narrower mixture's density to that of the draws has mean 1."""
    rng = np.random.default_rng(seed)
    wide = mixture(rng, ties)
    free = np.append(np.ones(6, bool), ties == np.arange(3))
    narrow = replace(
        wide,
        factors=wide.factors * np.where(free, 0.85, 1.0)[:, None],
        log_weights=np.log([[0.2, 0.3, 0.5]]),
    )
    states = wide.drawn(rng, 40_000)
    np.testing.assert_array_equal(states[..., 7:], states[..., 7 + ties])

    assert_mean(np.exp(narrow.log_density(states) - wide.log_density(states))[0], 1.0, detectable=0.1)


def test_the_base_measure_is_rotations_of_mass_pi_squared(seed: int) -> None:
    """Of one object without a point: the integral over a box round the centre, by draws that are even there.

    Turns are even in a ball of rotation vectors; dR = (2 - 2 cos t) / t^2 / 8 d^3 v where rotations have
    mass pi^2 (Haar of mass 1 has 1 / (8 pi^2) of it).
    """
    rng = np.random.default_rng(seed)
    one = StateMixture(
        log_weights=np.zeros((1, 1)),
        centres=np.array([[[1.0, 0, 0, 0, 0.1, 0.2, 0.3, -3, -3, -3]]]),
        factors=np.diag([0.02] * 3 + [0.2] * 3 + [0.05] * 3)[None, None],
        points_m=np.zeros((1, 3)),
        ties=BOX[None],
    )
    count, reach = 60_000, 3.0
    widths = np.array([0.02] * 3 + [0.2] * 3 + [0.05] * 3)
    steps = rng.uniform(-reach, reach, (count, 9)) * widths
    turns = Rotation.from_rotvec(steps[:, 3:6])
    states = np.concatenate(
        [turns.as_quat(scalar_first=True), [0.1, 0.2, 0.3] + steps[:, :3], steps[:, 6:] - 3], axis=1
    )
    angle = turns.magnitude()
    volume = np.prod(2 * reach * widths) * (2 - 2 * np.cos(angle)) / angle**2 / 8
    inside = math.erf(reach / math.sqrt(2)) ** 9
    total = np.exp(one.log_density(states[None]))[0] * volume
    assert_mean(total, inside, detectable=0.25)


def test_sizes_are_normal_about_the_shapes(seed: int) -> None:
    """Of a box three sizes, of a can two: the density integrates to 1 over those that are free."""
    rng = np.random.default_rng(seed)
    sizes = SizePrior(
        log_half=np.log([[0.02, 0.05, 0.1], [0.03, 0.03, 0.06]]),
        sigma=np.array([[0.1, 0.05, 0.02], [0.06, 0.06, 0.03]]),
        ties=np.stack([BOX, CAN]),
    )
    for one, free in ((0, 3), (1, 2)):
        owner = np.array([one])
        steps = rng.uniform(-5, 5, (20_000, 3)) * sizes.sigma[one]
        states = np.concatenate([np.zeros((20_000, 7)), sizes.log_half[one] + steps], axis=1)[None]
        tied = sizes.tied(states, owner)[..., 7:]
        volume = np.prod((10 * sizes.sigma[one])[sizes.ties[one] == np.arange(3)])
        assert free == (sizes.ties[one] == np.arange(3)).sum()
        assert_mean(np.exp(sizes.log_density(tied, owner))[0] * volume, 1.0, detectable=0.2)
        np.testing.assert_allclose(
            np.diff(tied[0, :, :2]).ravel() if one else 0.0, 0.0, atol=1e-12
        )  # a can's radii are one


def test_small_things_are_less_surely_of_their_size() -> None:
    """Errors: of the camera's scale, and of faces over the half size; a round thing has one radius."""
    box = trimesh.creation.box((0.1, 0.05, 0.02))
    can = trimesh.creation.cylinder(0.03, 0.1, sections=64)
    objects = [scene_object(name, one.vertices, one.faces) for name, one in (("box", box), ("can", can))]

    sizes = SizePrior.of(objects, 2e-3)

    np.testing.assert_allclose(sizes.sigma[0], np.hypot(SUPPORT_ERROR, 2e-3 / np.array([0.05, 0.025, 0.01])))
    assert sizes.ties[0].tolist() == [0, 1, 2]
    assert sizes.ties[1].tolist() == [0, 0, 2]
    assert sizes.sigma[1, 0] == sizes.sigma[1, 1]
    assert pytest.approx(0.01) == SUPPORT_ERROR
