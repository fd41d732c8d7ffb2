"""Draws through unexplained points against plain draws of the prior."""

from functools import partial

import numpy as np
import pytest
import trimesh

from pipeline.benchmarks.point_proposals import (
    PosesThroughPoints,
    Shell,
    draws_through_points,
    unexplained_points_m,
)
from pipeline.benchmarks.pose_kernels import PoseKernels
from scene.hidden.hidden_objects import mean_ratio
from scene.hidden.pose_draws import PriorDraws
from shapes.geometry.poses import motions_of
from tests.scene.hidden.test_pose_draws import FOCAL, PRIOR, SHOWN, SIZE_M, brick, images


def test_the_point_that_nothing_explains() -> None:
    """The pixel's, on its ray."""
    row, column = SHOWN
    expected = 0.7 * np.array([(column - 11.5) / FOCAL, (row - 8.5) / FOCAL, 1.0])

    np.testing.assert_allclose(unexplained_points_m(images()), expected[None], atol=1e-6)


def test_the_shell_holds_the_surface_and_little_else(seed: int) -> None:
    """All points of the faces but at most one in a thousand; no more than a layer about them."""
    shell = Shell.of(brick())
    surface_m = np.asarray(trimesh.creation.box(SIZE_M).sample(4000, seed=seed), float)

    assert shell.holds(surface_m).mean() > 0.999
    assert shell.holds(shell.draw(np.random.default_rng(seed), 1000)).all()
    assert not shell.holds(np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]])).any()


@pytest.mark.parametrize("rounds", [0, 1, 2])
def test_weights_turn_the_mixture_into_the_prior(seed: int, rounds: int) -> None:
    """The mean weight is one, and weighted means of the pose are the prior's: each missed once in 16,000.

    Before the mixture is fitted, and after, with kernels: to weights that prefer some poses.
    """
    rng = np.random.default_rng(seed)
    points_m = np.array([[0.05, 0.0, 0.6], [0.05, 0.04, 0.62], [-0.2, 0.0, 0.7]])
    proposal = PosesThroughPoints.even(brick(), PRIOR, points_m)
    assert proposal is not None
    for _ in range(rounds):
        poses = proposal.draw(rng, [brick()], 512)[0]
        proposal = proposal.fitted(rng, poses, proposal.log_weights(poses) + 40 * poses[:, 0, 3])
    assert (proposal.kernels is not None) == (rounds > 0)

    poses = proposal.draw(rng, [brick()], 2**16)[0]
    weights = np.exp(proposal.log_weights(poses))

    plain = PRIOR.draw(rng, [brick()], 2**16)[0]
    told = np.concatenate([np.ones((2**16, 1)), poses[:, :3, 3], poses[:, 2, :3] ** 2], axis=1)
    expected = np.concatenate([np.ones((2**16, 1)), plain[:, :3, 3], plain[:, 2, :3] ** 2], axis=1)
    told *= weights[:, None]
    error = np.sqrt((told.var(axis=0) + expected.var(axis=0)) / 2**16)
    assert (np.abs(told.mean(axis=0) - expected.mean(axis=0)) < 4 * error + 1e-12).all()


def test_the_density_of_kernels_is_that_of_their_draws(seed: int) -> None:
    """Against a wider mixture: importance weights have mean one, missed once in 16,000."""
    rng = np.random.default_rng(seed)
    centres = motions_of(rng.normal(size=(6, 6)) * np.repeat([0.01, 0.2], 3))
    kernels = PoseKernels(centres=centres[:3])
    wider = PoseKernels(centres=centres)

    poses = wider.draw(rng, 2**15)
    weights = np.exp(kernels.log_density(poses) - wider.log_density(poses))

    assert abs(weights.mean() - 1) < 4 * weights.std() / np.sqrt(2**15)


def test_points_out_of_reach_are_left_out() -> None:
    """None is left of those a metre away."""
    assert PosesThroughPoints.even(brick(), PRIOR, np.array([[0.0, 0.0, 2.0]])) is None


def test_the_mean_ratio_is_that_of_plain_draws(seed: int) -> None:
    """Against all prior poses rendered: four standard errors, of which the point's share is many."""
    plain = PriorDraws(objects=[brick()], prior=PRIOR, images=images())
    batches = [plain.draw(np.random.default_rng([seed, at]), 2**14)[1] for at in range(4)]
    ratios = np.exp(np.concatenate(batches))

    rng = np.random.default_rng(seed)
    draws_of = partial(draws_through_points, rng)
    found = mean_ratio(rng, [brick()], PRIOR, images(), draws=2**15, keep=256, draws_of=draws_of)

    error = np.hypot(ratios.std() / np.sqrt(len(ratios)), found.standard_error)
    assert ratios[ratios > 2].sum() / len(ratios) > 4 * error
    assert abs(found.mean - ratios.mean()) < 4 * error


def test_fitted_draws_find_the_point(seed: int) -> None:
    """Poses that the image speaks for are drawn ten times as often as from the prior, or more."""
    plain = PriorDraws(objects=[brick()], prior=PRIOR, images=images())
    through = draws_through_points(np.random.default_rng(seed), [brick()], PRIOR, images(), 2**14)

    count = 2**14
    seldom = (plain.draw(np.random.default_rng(seed), count)[1] > 2).sum()
    poses, _ = through.draw(np.random.default_rng(seed), count)
    often = (images().log_ratios(brick(), poses[0]) > 2).sum()

    assert often > 10 * max(seldom, 1)
