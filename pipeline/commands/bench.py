"""`voxscene bench`: measurements beside peers, printed as tables."""

from __future__ import annotations

from pipeline.cli import LazyGroup

command = LazyGroup(
    name="bench",
    package="pipeline.commands.benches",
    members=("shapes", "slam", "poses", "sampler", "speed", "air", "occlusion"),
    help="Measure speed and accuracy against peers.",
)
