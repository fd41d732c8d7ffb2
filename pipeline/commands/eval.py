"""`voxscene eval`: runs against the truth."""

from __future__ import annotations

from pipeline.cli import LazyGroup

command = LazyGroup(
    name="eval",
    package="pipeline.commands.evaluations",
    members=("slam", "shapes", "poses"),
    help="Compare a run with the truth.",
)
