"""`voxscene learn`: what does the object look like, voxel by voxel, and how sure are we."""

from __future__ import annotations

import re
from pathlib import Path

import click

from pipeline.damage import report_damage
from pipeline.errors import ConfigError
from pipeline.options import Common, RecordingSource, common_options, numbers, recording_options, run_options

BOX_NUMBERS = 6


@click.command(name="learn")
@run_options
@click.option("--name", required=True, help="Name of the shape; it becomes RUN/shapes/NAME.npz.")
@click.option(
    "--box",
    metavar="XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX",
    help="Where the object is, in metres in the first depth frame's camera; found by itself otherwise.",
)
@click.option("--pitch", "pitch_m", type=float, metavar="METRES", help="Edge of a voxel; 0.005.")
@click.option(
    "--poses",
    type=click.Choice(["slam", "recorded"]),
    default="slam",
    show_default=True,
    help="Where the camera's poses come from.",
)
@recording_options
@common_options("recording", "slam", "learn")
@click.pass_context
def command(
    ctx: click.Context,
    common: Common,
    source: RecordingSource,
    run_path: Path,
    force: bool,
    name: str,
    box: str | None,
    pitch_m: float | None,
    poses: str,
) -> None:
    """Learn the shape of the object that REC looks at.

    Runs slam first if RUN has none.
    """
    from pipeline.project import FILE_NAME
    from pipeline.publishing.publish import stage_document
    from pipeline.session import open_session
    from pipeline.stages.learn import learn_stage

    if not re.fullmatch(FILE_NAME, name):
        raise ConfigError(f"--name {name}: use letters, digits, dots, dashes and underscores")
    options = {"box": _box(box), "pitch_m": pitch_m}
    with open_session(common, source, run_path, force=force) as session:
        learn_stage(session, name, options, recorded_poses=poses == "recorded")
        damage = session.damage
    document = stage_document(session.run, f"learn/{name}")
    size = document["size_m"]
    lines = [
        f"{name}: {document['seen_occupied']} voxels of {1000 * document['pitch_m']:g} mm seen occupied, "
        f"{document['enclosed']} enclosed, "
        f"{' x '.join(f'{100 * side:.1f}' for side in size)} cm; {document['seconds']:.1f} s",
        f"shape: {run_path / 'shapes' / f'{name}.npz'}",
    ]
    common.report(document, lines)
    ctx.exit(report_damage(source.path, damage))


def _box(text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    values = numbers("--box", text)
    if len(values) != BOX_NUMBERS:
        raise ConfigError(f"--box {text}: write six numbers, xmin,ymin,zmin,xmax,ymax,zmax in metres")
    return values
