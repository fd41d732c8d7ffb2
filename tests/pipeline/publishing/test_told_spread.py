"""Spreads in words: no more digits than samples, shares of modes, and whether chains agree."""

import pytest

from pipeline.publishing.told_spread import (
    agreement_text,
    label_text,
    length_text,
    modes_text,
    position_text,
    rotation_text,
    verdict_text,
)

SURE = {
    "name": "mug",
    "presence": 0.98,
    "middle_std_m": 0.00123,
    "rotation_std_rad": 0.02,
    "converged": True,
    "modes_converged": True,
    "r_hat": 1.01,
    "effective_samples": 500.0,
    "modes": [{"probability": 1.0, "middle_std_m": 0.00123}],
}
TURNED = SURE | {
    "converged": False,
    "modes_converged": False,
    "r_hat": 1.9,
    "effective_samples": 6.0,
    "modes": [{"probability": 0.57, "middle_std_m": 0.00058}, {"probability": 0.43, "middle_std_m": 0.001}],
}


@pytest.mark.parametrize(
    ("metres", "converged", "text"),
    [
        *(
            (0.00123, True, "1.2 mm"),
            (0.00123, False, "1 mm"),
            (0.0996, True, "10 cm"),
            (0.0, True, "0.0 mm"),
        ),
        *(
            (0.0123, True, "1.2 cm"),
            (0.000456, False, "0.5 mm"),
            (1.25, False, "100 cm"),
            (0.00996, True, "10 mm"),
        ),
    ],
)
def test_lengths(metres: float, converged: bool, text: str) -> None:
    """In the unit that a person would take."""
    assert length_text(metres, converged=converged) == text


def test_what_is_sure_is_said_short() -> None:
    """Value and spread."""
    assert label_text(SURE) == "mug 98%, +- 1.2 mm"
    assert (modes_text(SURE), agreement_text(SURE)) == ("", "")
    assert (position_text(SURE), rotation_text(SURE)) == ("+- 1.2 mm", "+- 1.1 deg")


def test_what_is_not_sure_is_said_with_its_doubt() -> None:
    """The share of the mode, that chains do not agree, and one digit."""
    assert label_text(TURNED) == "mug 98%, +- 1 mm? (57% of 2 poses)"
    assert modes_text(TURNED) == "2 modes, 57, 43%?, +- 0.6 mm in the first; chains hardly moved between them"
    assert agreement_text(TURNED) == "not converged, R-hat 1.90"
    assert agreement_text(TURNED | {"r_hat": None}) == "not converged, R-hat infinite"


def test_shares_of_less_than_a_percent_are_not_told_as_none() -> None:
    """A mode that is there has a share."""
    modes = [{"probability": share, "middle_std_m": 0.001} for share in (0.796, 0.2, 0.004)]
    assert modes_text(SURE | {"modes": modes}).startswith("3 modes, 80, 20, <1%")


def test_the_verdict_says_what_to_do() -> None:
    """With the sweeps that would do."""
    parse = {
        "samples": 320,
        "sweeps_advised": 2400,
        "effective_samples": 6.2,
        "r_hat": 1.94,
        "converged": False,
        "objects": [SURE, TURNED],
    }
    assert verdict_text(parse) == (
        "not converged: R-hat 1.94, 6 effective samples of 320; standard deviations are too small; "
        "try -s parse.sweeps=2400"
    )
    assert "places agree, rarer poses may be missing" in verdict_text(parse | {"objects": [SURE]})
    assert verdict_text(parse | {"converged": True, "r_hat": 1.02}).startswith("converged: R-hat 1.02")
    assert "no pose was sampled" in verdict_text(parse | {"objects": []})
    assert "too few samples" in verdict_text(parse | {"effective_samples": None, "r_hat": None})
