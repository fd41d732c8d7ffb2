"""Odds of maps against what log ratios that are right would say."""

import numpy as np

from slam.map_hypotheses.map_odds import log_odds

IMAGES, BLOCKS = 100, 20


def test_overstated_log_ratios_are_put_right(seed: int) -> None:
    """Gaussian blocks whose mean is half their variance, all overstated alike: the odds are the sum before.

    The larger of two variances: from 2,000 blocks, to 3 in 100, and from 1,000 images, to 4.5 in 100. Four
    times that is allowed.
    """
    rng = np.random.default_rng(seed)
    log_ratios = rng.normal(-0.01, np.sqrt(0.02), (1000, 2))

    odds = log_odds(np.stack([np.zeros_like(log_ratios), 30.0 * log_ratios]))

    mean, of_images = log_ratios.sum(), log_ratios.sum(axis=1)
    variance = max((log_ratios**2).sum(), len(of_images) * of_images.var(ddof=1))
    assert odds[0] == 0
    np.testing.assert_allclose(odds[1], -2 * mean**2 / variance, rtol=1e-9)
    np.testing.assert_allclose(odds[1] / mean, -2 * mean / (0.02 * log_ratios.size), rtol=0.18)


def test_blocks_of_an_image_that_err_alike_count_once(seed: int) -> None:
    """As overstated blocks of which all of an image are the same: the odds are those of the images."""
    rng = np.random.default_rng(seed)
    of_images = rng.normal(-0.2, np.sqrt(0.4), IMAGES)
    repeated = np.repeat(of_images[:, None], BLOCKS, axis=1)

    odds = log_odds(np.stack([np.zeros((IMAGES, BLOCKS)), repeated]))

    np.testing.assert_allclose(odds[1], -2 * of_images.sum() ** 2 / (IMAGES * of_images.var(ddof=1)))


def test_a_wrong_map_is_told_by_many_blocks_and_not_by_one() -> None:
    """The same sum of nats, in one block or in all."""
    one, many = np.zeros((2, IMAGES, BLOCKS))
    one[0, 0], many[:] = -400.0, -400.0 / (IMAGES * BLOCKS)

    odds = log_odds(np.stack([np.zeros((IMAGES, BLOCKS)), one, many]))

    np.testing.assert_allclose(odds, [0.0, -2.0, -2.0 * IMAGES * BLOCKS])


def test_one_image_has_no_spread() -> None:
    """Its blocks alone tell."""
    np.testing.assert_allclose(log_odds(np.array([[[0.0, 0.0]], [[-1.0, -1.0]]])), [0.0, -4.0])


def test_maps_that_are_no_numbers_have_no_odds() -> None:
    """Beside others, and alone."""
    unknown = np.full((IMAGES, BLOCKS), -np.inf)

    assert log_odds(np.stack([unknown, np.ones((IMAGES, BLOCKS))])).tolist() == [-np.inf, 0.0]
    assert log_odds(unknown[None]).tolist() == [-np.inf]
