"""`voxscene learn`: what does the object look like, voxel by voxel, and how sure are we."""

from __future__ import annotations

import re
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click

from pipeline.damage import report_damage
from pipeline.errors import ConfigError
from pipeline.options import (
    Common,
    OutputFile,
    RecordingSource,
    common_options,
    numbers,
    recording_options,
    run_options,
)

if TYPE_CHECKING:
    from pipeline.stages.region import LearnedRegion

LARGE_M = 0.4
"""Larger regions are as a rule several things, or a piece of furniture."""


@click.command(name="learn")
@run_options
@click.option("--name", required=True, help="Name of the shape; it becomes RUN/shapes/NAME.npz.")
@click.option(
    "--box",
    metavar="XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX",
    help="Where the object is, in metres in the camera of the first frame that is used; found by itself by "
    "default.",
)
@click.option(
    "--pixel",
    metavar="U,V",
    help="Column and row of the object in the first frame that is used, where it is not what the camera "
    "looks at.",
)
@click.option(
    "--preview",
    type=OutputFile(".png"),
    metavar="OUT.png",
    help="Only draw the region that would be learned, on the first frame that is used: neither lost nor "
    "without a pose.",
)
@click.option("--pitch", "pitch_m", type=float, metavar="METRES", help="Edge of a voxel; 0.005 by default.")
@click.option(
    "--poses",
    type=click.Choice(["slam", "recorded"]),
    default="slam",
    show_default=True,
    help="Source of the camera's poses: slam, or those in the recording.",
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
    pixel: str | None,
    preview: Path | None,
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
    from pipeline.stages.region import preview_region

    if not re.fullmatch(FILE_NAME, name):
        raise ConfigError(f"--name {name}: use letters, digits, dots, dashes and underscores")
    options = {
        "box": _numbers("--box", box, 6, "six numbers, xmin,ymin,zmin,xmax,ymax,zmax in metres"),
        "pixel": _numbers("--pixel", pixel, 2, "column,row of the object in the first frame that is used"),
        "pitch_m": pitch_m,
    }
    if preview is not None:
        with open_session(common, source, run_path, force=force) as session:
            region = preview_region(session, options, preview, recorded_poses=poses == "recorded")
            damage = session.recording.damage
        common.report(*_region_told(region, preview))
        ctx.exit(report_damage(source.path, damage))
    with open_session(common, source, run_path, force=force) as session:
        learn_stage(session, name, options, recorded_poses=poses == "recorded")
        damage = session.damage
    document = stage_document(session.run, f"learn/{name}")
    size = document["size_m"]
    lines = [
        f"{name}: {document['seen_occupied']} voxels of {1000 * document['pitch_m']:g} mm seen occupied, "
        f"{document['enclosed']} enclosed, "
        f"{' x '.join(f'{100 * side:.1f}' for side in size)} cm; {document['seconds']:.1f} s",
        *_surface(document),
        f"shape: {run_path / 'shapes' / f'{name}.npz'}; look at it: voxscene review {quote(str(run_path))}",
    ]
    common.report(document, lines)
    ctx.exit(report_damage(source.path, damage))


def _region_told(region: LearnedRegion, picture: Path) -> tuple[dict[str, Any], list[str]]:
    """The document and the lines on a region that would be learned."""
    size = " x ".join(f"{100 * side:.0f}" for side in region.size_m)
    lines = [f"{picture}: {size} cm, {region.voxels} voxels"]
    if max(region.size_m) > LARGE_M:
        lines.append("that is more than a thing in a hand: point at the object with --pixel, or give --box")
    document = {"preview": str(picture), "size_m": list(region.size_m), "voxels": region.voxels}
    return document, lines


def _numbers(option: str, text: str | None, count: int, meant: str) -> tuple[float, ...] | None:
    if text is None:
        return None
    values = numbers(option, text)
    if len(values) != count:
        raise ConfigError(f"{option} {text}: write {meant}")
    return values


def _surface(document: dict[str, Any]) -> list[str]:
    """How much of the surface was seen, and what is doubtful."""
    shares = document["surface"]
    told = (
        []
        if shares is None
        else [
            f"surface: {shares['seen']:.0%} seen, {shares['inferred']:.0%} inferred, "
            f"{shares['never_seen']:.0%} never seen"
        ]
    )
    return told + [f"warning: {warning}" for warning in document["warnings"]]
