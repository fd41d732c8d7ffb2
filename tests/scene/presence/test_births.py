"""Where candidates are drawn when the search found nothing."""

from typing import Any, cast

import numpy as np

from scene.presence import births


class Frames:
    """Of six pixels; whoever asks what nothing shows gets none."""

    pixels = 6

    def shown(self, *given: Any) -> None:
        """There is nothing to render."""
        raise AssertionError(given)


def test_nothing_stands_beside_where_nothing_was_found() -> None:
    """A renderer of no objects would divide by their number."""
    given = cast("Any", Frames()), cast("Any", None), [np.zeros((1, 7))] * 2, np.zeros(2, bool)
    front_m, gain = births._others(np.random.default_rng(0), *given)
    assert front_m.shape == gain.shape == (2, 6)
    assert np.isposinf(front_m).all()
    assert not gain.any()
