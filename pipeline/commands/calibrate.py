"""`voxscene calibrate`: what a depth sensor's own recordings tell of its noise and distortion."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from pipeline.damage import report_damage
from pipeline.errors import ConfigError
from pipeline.options import AnyPath, Common, RecordingSource, common_options, several_recordings_options
from pipeline.progress import tell

FRAMES = 48
"""Of each recording: four times as many as a run looks at."""


@click.command(name="calibrate")
@click.option(
    "-o",
    "--output",
    "sensor_path",
    type=AnyPath(),
    required=True,
    metavar="SENSOR.toml",
    help="The profile, for --sensor.",
)
@click.option(
    "--frames",
    type=click.IntRange(min=1, max=1000),
    default=FRAMES,
    show_default=True,
    help="Of each recording, evenly spread, from which noise and the unknown layer are learned.",
)
@click.option(
    "--field/--no-field",
    default=True,
    help="Track the camera, where it moves, for the sensor's distortion; minutes for hundreds of frames.",
)
@several_recordings_options
@common_options("recording", "slam", computes=True)
@click.pass_context
def command(
    ctx: click.Context,
    common: Common,
    sources: Sequence[RecordingSource],
    sensor_path: Path,
    frames: int,
    field: bool,
) -> None:
    """Learn the sensor from its recordings, without any truth.

    Noise over depth, missing returns, how far errors are alike, how well pixels foretell each other, and,
    where the camera moves, the static distortion. Objects in view do no harm if there are smooth parts. An
    earlier profile is replaced, and no other file.
    """
    from pipeline.atomic import check_output, check_replaced
    from pipeline.calibration.calibrate import calibrate
    from pipeline.calibration.told import document_of, lines_of, warnings_of
    from pipeline.quiet_stdout import stdout_to_stderr
    from pipeline.stored_profile import StoredProfile, is_profile
    from recordings.reading import open_recording

    check_output(sensor_path)
    check_replaced(sensor_path, "sensor profile", is_profile)
    options = [one.read_options(common.settings) for one in sources]
    if any(one.sensor is not None for one in options):
        raise ConfigError("calibrate learns a sensor from depths as they were recorded; leave out --sensor")
    opened = [(one.path, open_recording(one.path, how)) for one, how in zip(sources, options, strict=True)]
    with stdout_to_stderr():
        found = calibrate(opened, common, frames, field=field)
    StoredProfile(found.profile).save(sensor_path)
    common.report(document_of(found), lines_of(found, str(sensor_path)))
    for sentence in warnings_of(found):
        tell(f"voxscene: {sentence}", err=True)
    ctx.exit(max(report_damage(path, one) for (path, _), one in zip(opened, found.damage, strict=True)))
