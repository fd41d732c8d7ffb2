"""How a spread is put into words: value, +-, share of the mode, and whether chains agree on it.

The terminal, the report, labels and run.mcap say the same, from the same fields of summary.json.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

SURE = 0.995
"""Share of a mode from which on the others are not worth a word: it would be written as 100%."""

REAL_CAMERA_FACTOR = 1.3, 3.7
"""How many times the reported standard deviation the camera was off in three real recordings, the truth's own
errors included: error from the first pose over the median (docs/benchmarks.md, C6 to C8): 40.4 mm over 32 and
10.2 over 4.4 in 400 and 60 frames of the 7-Scenes kitchen, 7.3 over 2.0 in the hand-held shelf."""


def length_text(metres: float, *, converged: bool) -> str:
    """In millimetres or centimetres; one digit where few samples could not fill a second."""
    unit, value = ("cm", 100 * metres) if metres >= 0.01 else ("mm", 1000 * metres)
    return f"{_digits(value, 2 if converged else 1)} {unit}"


def position_text(one: Mapping[str, Any]) -> str:
    """+- of the middle of an object of summary.json, over all samples."""
    return f"+- {length_text(one['middle_std_m'], converged=one['converged'])}"


def camera_text(slam: Mapping[str, Any]) -> str:
    """+- of the camera's position over the frames of summary.json's `slam`; empty where all were lost."""
    if slam["position_std_m"] is None:
        return ""
    median, largest = (
        length_text(slam[key], converged=True) for key in ("position_std_m", "largest_position_std_m")
    )
    low, high = REAL_CAMERA_FACTOR
    return (
        f"position +- {median} (median), {largest} in frame {slam['least_sure_frame']}, if only noise and "
        f"distortion of the sensor err; real recordings erred {low:g} to {high:g} times as much"
    )


def undiscovered_text(probability: float | None) -> str:
    """What a search for the map of few views may have missed; empty where nothing is known of it."""
    if probability is None or not 1 - SURE <= probability <= 1:
        return ""
    return (
        f"views are few, and the search may have missed the true map (probability {probability:.0%}): "
        "give views between them"
    )


def rotation_text(one: Mapping[str, Any]) -> str:
    """+- of the orientation of an object of summary.json, over all samples."""
    degrees = math.degrees(one["rotation_std_rad"])
    return f"+- {_digits(degrees, 2 if one['converged'] and one['modes_converged'] else 1)} deg"


def presence_text(one: Mapping[str, Any]) -> str:
    """Probability that an object is there, with its standard error where that shows."""
    error = one.get("presence_std") or 0.0
    return f"{one['presence']:.2f}" + (f" +- {error:.2f}" if error >= 0.005 else "")


def label_text(one: Mapping[str, Any]) -> str:
    """What stands beside an object in a picture; a question mark where chains do not agree on the spread."""
    share = one["modes"][0]["probability"] if one["modes"] else 1.0
    mode = f" ({share:.0%} of {len(one['modes'])} poses)" if share < SURE else ""
    doubt = "" if one["converged"] else "?"
    return f"{one['name']} {one['presence']:.0%}, {position_text(one)}{doubt}{mode}"


def modes_text(one: Mapping[str, Any]) -> str:
    """Shares of the modes of an object's pose, and the spread in the heaviest; empty where there is one."""
    modes: Sequence[Mapping[str, Any]] = one["modes"]
    if not modes or modes[0]["probability"] >= SURE:
        return ""
    own = length_text(modes[0]["middle_std_m"], converged=one["converged"])
    doubt = "" if one["modes_converged"] else "; chains hardly moved between them"
    return f"{len(modes)} modes, {shares_text(one)}, +- {own} in the first{doubt}"


def shares_text(one: Mapping[str, Any]) -> str:
    """Shares of the modes of an object's pose; a question mark where chains do not agree on them."""
    percent = (100 * mode["probability"] for mode in one["modes"])
    shares = ", ".join("<1" if 0 < share < 1 else f"{share:.0f}" for share in percent)
    return f"{shares}%{'' if one['modes_converged'] else '?'}"


def agreement_text(one: Mapping[str, Any]) -> str:
    """Of an object of summary.json; empty where its chains agree."""
    return "" if one["converged"] else f"not converged, R-hat {_r_hat(one)}"


def verdict_text(parse: Mapping[str, Any]) -> str:
    """Whether the spreads of a parsed scene can be believed, and what to do where they cannot."""
    if not parse["objects"]:
        return "no pose was sampled; presences have standard errors of their own"
    if parse["effective_samples"] is None:
        doubt = "standard deviations may be too small; raise parse.sweeps"
        return f"too few samples to tell whether chains agree: {doubt}"
    figures = (
        f"R-hat {_r_hat(parse)}, {parse['effective_samples']:.0f} effective samples of {parse['samples']}"
    )
    if parse["converged"]:
        return f"converged: {figures}"
    advised = f"try -s parse.sweeps={parse['sweeps_advised']}"
    objects: Sequence[Mapping[str, Any]] = parse["objects"]
    if all(one["converged"] and one["modes_converged"] for one in objects):
        return f"not converged: {figures}; places agree, rarer poses may be missing; {advised}"
    return f"not converged: {figures}; standard deviations are too small; {advised}"


def _r_hat(document: Mapping[str, Any]) -> str:
    """Null where it is infinite, or where there are too few samples."""
    if document["r_hat"] is not None:
        return f"{document['r_hat']:.2f}"
    return "unknown" if document["effective_samples"] is None else "infinite"


def _digits(value: float, count: int) -> str:
    """So many significant digits, never in powers of ten."""
    rounded = float(f"{value:.{count - 1}e}")
    decimals = max(count - 1 - _exponent(rounded), 0)
    return f"{rounded:.{decimals}f}"


def _exponent(value: float) -> int:
    return int(f"{value:e}".partition("e")[2]) if value else 0
