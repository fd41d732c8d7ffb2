"""Prior odds of presence as the search takes them: a maximum has no volume of its own."""

from __future__ import annotations

import math

LOG_SHARE_OF_POSES = -20.0
"""Log prior probability of the poses that fit alike: within about 2 mm and 2 degrees, of all on a table."""

LOG_SPINS = math.log(360 / 4)
"""Log of how many times as many poses fit alike of a shape that is round about a line: it spins freely."""


def log_prior_odds(presence: float) -> float:
    """Of an object being there in one pose, up to poses that fit alike, against its being absent."""
    return math.log(presence / (1 - presence)) + LOG_SHARE_OF_POSES
