"""`voxscene slam`: where was the camera, in every frame, and how sure are we."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import Any

import click

from pipeline.damage import report_damage
from pipeline.options import Common, RecordingSource, common_options, recording_options, run_options


@click.command(name="slam")
@run_options
@click.option(
    "--motion",
    type=click.Choice(["free", "orbit"]),
    help="Prior over the camera's motion; free by default.",
)
@click.option(
    "--particles", type=int, metavar="K", help="Number of trajectories that are drawn; 64 by default."
)
@click.option(
    "--proposal",
    type=click.Choice(["enumerate", "kiss", "both"]),
    help="Source of candidate poses: enumerated by search against the map, KISS-ICP, or both; enumerate by "
    "default.",
)
@recording_options
@common_options("recording", "slam")
@click.pass_context
def command(
    ctx: click.Context,
    common: Common,
    source: RecordingSource,
    run_path: Path,
    force: bool,
    motion: str | None,
    particles: int | None,
    proposal: str | None,
) -> None:
    """Find the camera in every frame of REC, with its uncertainty."""
    from pipeline.publishing.publish import stage_document
    from pipeline.session import open_session
    from pipeline.stages.slam import slam_stage

    with open_session(common, source, run_path, force=force) as session:
        slam_stage(session, {"motion": motion, "particles": particles, "proposal": proposal})
        damage = session.damage
    document = stage_document(session.run, "slam")
    paths = document["path_probabilities"]
    lines = [
        f"{document['frames']} frames over {document['length_m']:.2f} m, {document['lost_frames']} lost, "
        f"{document['frames_per_second']:.1f} a second, compiled in {document['compile_s']:.1f} s",
        *_doubts(document),
        f"trajectory: {run_path / 'trajectory.tum'}; look at it: voxscene review {quote(str(run_path))}",
    ]
    if len(paths) > 1:
        lines.insert(1, f"{len(paths)} paths explain what was seen, the reported one with {paths[0]:.0%}")
    common.report(document, lines)
    ctx.exit(report_damage(source.path, damage))


def _doubts(document: dict[str, Any]) -> list[str]:
    """How surely the camera is known, and where it was lost."""
    from pipeline.publishing.told_spread import camera_text, undiscovered_text

    texts = camera_text(document), undiscovered_text(document["undiscovered_probability"])
    lines = [text for text in texts if text]
    if document["distortion_per_m"] is not None:
        lines.append(
            f"the sensor's inverse depths err by {document['distortion_per_m']:.1g}/m over the image, "
            f"known to {document['distortion_std_per_m']:.1g}/m: sensor.toml"
        )
    if document["lost"]:
        first = document["lost"][0]
        lines.append(f"lost first in frame {first['frame']}, at {first['stamp']} s; all stand in lost.txt")
    return lines
