"""Telling that part of a recording is lost: one line on stderr, and the exit code of the command."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.cli import DAMAGED
from pipeline.progress import tell

if TYPE_CHECKING:
    from recordings.types import Damage


def describe(damage: Damage) -> str:
    """What was lost, in a few words."""
    if not damage:
        return "nothing lost" if damage.verified else "nothing lost as far as can be told"
    lost = [
        f"{count} {noun}{'s' * (count != 1)}"
        for count, noun in ((damage.lost_chunks, "chunk"), (damage.lost_messages, "message"))
        if count
    ]
    return f"at least {' and '.join(lost)} lost"


def report_damage(path: Path, damage: Damage) -> int:
    """Say on stderr what was lost, or that nothing could be checked; give the exit code."""
    if damage:
        tell(f"voxscene: {path} is damaged: {describe(damage)}", err=True)
        return DAMAGED
    if not damage.verified:
        tell(f"voxscene: {path} was written without checksums: its content is unverified", err=True)
    return 0
