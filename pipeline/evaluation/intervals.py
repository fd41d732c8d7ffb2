"""How sure a share is that was counted."""

from __future__ import annotations

from scipy.stats import binomtest


def wilson_interval(right: int, count: int) -> tuple[float, float]:
    """Wilson's 95% interval of the share of `count` independent trials that are right (Wilson 1927).

    Args:
        right: so many.
        count: at least one.
    """
    interval = binomtest(right, count).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)
