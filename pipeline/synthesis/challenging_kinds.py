"""The kinds of challenging images: imported by commands that list them, so it imports nothing heavy."""

from __future__ import annotations

from collections.abc import Mapping

KINDS: Mapping[str, tuple[float, float]] = {
    "single": (0.95, 1.0),
    "stacked": (0.6, 1.0),
    "partial": (0.2, 0.7),
    "occluded": (0.1, 0.6),
}
"""With the limits of the target's visible fraction."""
