"""Settings of a parse that cannot be used are refused with a line that says what to write."""

from typing import Any

import pytest

from scene.config import ParseConfig


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"objects": ("mug:0",)}, "'mug:0' must ask for 1 to 8 copies, such as mug:2"),
        ({"objects": ("mug:99",)}, "'mug:99' must ask for 1 to 8 copies, such as mug:2"),
        ({"objects": ("mug", "mug")}, "for two of a kind write mug:2"),
        ({"objects": ("mug:2",), "colour": "only"}, "name kinds alone"),
        ({"presence": 0.0}, "presence must lie between 0 and 1, got 0"),
        ({"presence": 1.0}, "presence must lie between 0 and 1, got 1"),
        (
            {"exact": ("a", "b", "c")},
            "got a,b,c: 7 sets of them would have to be rendered together, 32768 times",
        ),
        (
            {"exact": ("can",), "objects": ("mug",)},
            "exact names 'can', which is none of the objects asked for",
        ),
        ({"exact": ("mug",), "colour": "only"}, "exact needs depth images"),
        ({"likelihood": "cloud", "colour": "add"}, "does not go with likelihood cloud"),
        ({"frames": (10**20,)}, "frames must be numbers up to 2147483648"),
        ({"region": (0.0, 0.0, 0.0, 1.0, 0.0, 1.0)}, "region must be xmin"),
        ({"graph": "fix"}, "graph must be infer or fixed or search, got 'fix'"),
        ({"likelihood": "clouds"}, "likelihood must be depth or cloud, got 'clouds'"),
        ({"colour": "on"}, "colour must be off or add or only, got 'on'"),
        ({"proposals": "mask"}, "proposals must be points or masks or both, got 'mask'"),
        ({"objects": "mug"}, r"objects must be several names, such as \('mug',\)"),
        ({"exact": "mug"}, r"exact must be several names, such as \('mug',\)"),
    ],
)
def test_what_cannot_be_is_refused(settings: dict[str, Any], line: str) -> None:
    """None asked for, too many, a probability that is none, a volume of nothing, words that mean nothing."""
    with pytest.raises(ValueError, match=line):
        ParseConfig(**settings)


def test_a_copy_may_be_asked_for_exactly() -> None:
    """By the name that copies have."""
    assert ParseConfig(objects=("mug:2",), exact=("mug_2",)).exact == ("mug_2",)
