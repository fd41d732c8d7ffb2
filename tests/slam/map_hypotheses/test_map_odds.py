"""Odds of maps against what log ratios that are right would say."""

import numpy as np

from slam.map_hypotheses.map_odds import log_odds

BLOCKS = 2000


def test_overstated_log_ratios_are_put_right(seed: int) -> None:
    """Gaussian blocks whose mean is half their variance, all overstated alike: the odds are the sum before.

    The variance is estimated from 2,000 blocks: to 3 in 100, of which four times that is allowed.
    """
    rng = np.random.default_rng(seed)
    log_ratios = rng.normal(-0.01, np.sqrt(0.02), BLOCKS)
    overstated = np.stack([np.zeros(BLOCKS), 30.0 * log_ratios])

    odds = log_odds(overstated)

    mean, variance = log_ratios.sum(), (log_ratios**2).sum()
    assert odds[0] == 0
    np.testing.assert_allclose(odds[1], -2 * mean**2 / variance, rtol=1e-9)
    np.testing.assert_allclose(odds[1] / mean, -2 * mean / (0.02 * BLOCKS), rtol=0.12)


def test_a_wrong_map_is_told_by_many_blocks_and_not_by_one() -> None:
    """The same sum of nats, in one block or in all."""
    one, many = np.zeros((2, BLOCKS))
    one[0], many[:] = -400.0, -400.0 / BLOCKS

    odds = log_odds(np.stack([np.zeros(BLOCKS), one, many]))

    np.testing.assert_allclose(odds, [0.0, -2.0, -2.0 * BLOCKS])


def test_maps_that_are_no_numbers_have_no_odds() -> None:
    """Beside others, and alone."""
    unknown = np.full(BLOCKS, -np.inf)

    assert log_odds(np.stack([unknown, np.ones(BLOCKS)])).tolist() == [-np.inf, 0.0]
    assert log_odds(unknown[None]).tolist() == [-np.inf]
