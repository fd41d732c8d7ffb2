"""What in a run calls for care, in sentences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.publishing.told_spread import undiscovered_text, verdict_text
from pipeline.publishing.values import RunValues
from recordings.types import Damage

MAIN_SHARE = 0.9
"""Below this share of the samples, the largest mode does not stand for the posterior."""
SURE = 0.9


def warnings_of(values: RunValues, summary: Mapping[str, Any], damage: Damage) -> list[str]:
    """Sentences on what was lost, what is undecided and which spreads are too small.

    Args:
        values: of the run.
        summary: of the run, as in summary.json.
        damage: what was lost of the recording.
    """
    learned = summary.get("learn", {})
    found = [
        *_of_recording(damage),
        *_of_camera(values),
        *(f"{name}: {line}." for name, shape in learned.items() for line in shape["warnings"]),
    ]
    return [*found, *_of_scene(summary["parse"])] if "parse" in summary else found


def _of_recording(damage: Damage) -> list[str]:
    if not damage:
        return []
    return [
        f"The recording is damaged: {damage.lost_messages} messages and {damage.lost_chunks} chunks lost."
    ]


def _of_camera(values: RunValues) -> list[str]:
    slam = values.slam
    if slam is None:
        return []
    found = []
    if slam.lost.any():
        first = int(np.flatnonzero(slam.lost)[0])
        found.append(f"{int(slam.lost.sum())} of {len(slam)} frames are lost, the first is frame {first}.")
    if len(slam.path_probabilities) > 1:
        shares = ", ".join(f"{share:.0%}" for share in slam.path_probabilities)
        found.append(f"{len(slam.path_probabilities)} paths explain what was seen, with {shares}.")
    if text := undiscovered_text(float(slam.undiscovered)):
        found.append(f"{text[0].upper()}{text[1:]}.")
    return found


def _of_scene(parse: Mapping[str, Any]) -> list[str]:
    found = []
    if parse["objects"] and not parse["converged"]:
        found.append(f"Objects: {verdict_text(parse)}.")
    for one in parse["objects"]:
        largest = max((mode["probability"] for mode in one["modes"]), default=1.0)
        if largest < MAIN_SHARE:
            modes = len(one["modes"])
            found.append(
                f"{one['name']}: the reported pose holds {largest:.0%} of the samples; {modes} modes."
            )
        if one["presence"] < SURE:
            found.append(f"{one['name']}: present with a probability of only {one['presence']:.2f}.")
    return found
