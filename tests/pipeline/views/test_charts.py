"""Pictures beside the views."""

import pytest

from pipeline.views.charts import BACKGROUND, INK, LINE_PX, MARGIN_PX, MOST_BARS, presence_bars

FOUND = {"presence": 0.9, "middle_std_m": 0.001, "position_std_m": 0.001, "converged": True}


@pytest.mark.parametrize(
    ("found", "others", "lines"),
    [(1, 2, 3), (2, MOST_BARS - 2, MOST_BARS), (2, 19, MOST_BARS + 1), (12, 9, 13), (12, 0, 12)],
)
def test_what_was_found_has_a_bar_and_of_the_rest_the_likeliest(found: int, others: int, lines: int) -> None:
    """Many more than can be read in the panel are told in one line, the last, which has no bar."""
    parse = {
        "objects": [FOUND | {"name": f"found {number}"} for number in range(found)],
        "not_found": [{"name": f"other {number}", "presence": 0.01 * number} for number in range(others)],
    }

    image = presence_bars(parse, {})

    assert image.shape[0] == 2 * MARGIN_PX + lines * LINE_PX
    assert (image == INK).all(axis=2).any()
    last = image[-MARGIN_PX - LINE_PX : -MARGIN_PX, -150:]
    assert (last == BACKGROUND).all() == (lines < found + others)
