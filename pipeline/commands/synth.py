"""`voxscene synth`: recordings made in code, with the truth in the file."""

from __future__ import annotations

from pipeline.cli import LazyGroup

command = LazyGroup(
    name="synth",
    package="pipeline.commands.syntheses",
    members=("objects", "scenes", "challenging", "worlds", "air", "occlusion"),
    help="""Synthesise recordings, seeded, with the truth in the file.

    Every parameter of the room, the camera's path and the sensor is a setting, such as
    -s synth.sensor.noise.outlier_probability=0.05.
    """,
)
