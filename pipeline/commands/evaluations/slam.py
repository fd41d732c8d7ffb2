"""`voxscene eval slam`: a run's trajectory against the truth, and against other trackers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pipeline.errors import PipelineError
from pipeline.options import Common, common_options, words
from pipeline.peers import PEERS


@click.command(name="slam")
@click.argument("run_path", metavar="RUN", type=click.Path(path_type=Path))
@click.option(
    "--reference",
    required=True,
    type=click.Path(path_type=Path),
    metavar="TUM|MCAP",
    help="The truth: a TUM file, or a recording with poses.",
)
@click.option("--against", metavar="PEER,...", help=f"Run peers on the same frames: {', '.join(PEERS)}.")
@click.option(
    "--recording",
    type=click.Path(path_type=Path),
    metavar="REC",
    help="The frames for the peers, where the reference is not the recording itself.",
)
@common_options("recording")
def command(
    run_path: Path, reference: Path, against: str | None, recording: Path | None, common: Common
) -> None:
    """Trajectory errors of RUN and the coverage of its regions.

    Aligned (ATE), from the first pose, and of each step (RPE). Each peer is run with several settings, and
    its best result counts.
    """
    from pipeline.config import build
    from pipeline.evaluation.trajectories import (
        compared,
        frames_at,
        peer_errors,
        reference_trajectory,
        slam_errors,
    )
    from pipeline.quiet_stdout import stdout_to_stderr
    from pipeline.run_folder import RunFolder
    from recordings.options import ReadOptions
    from slam.result import SlamResult

    run = RunFolder(run_path, force=False)
    record = run.record("slam")
    if record is None:
        raise PipelineError(
            f"{run_path} holds no finished slam; make it with: voxscene slam REC -o {run_path}"
        )
    result = SlamResult.load(run.value_path("slam"))
    options = build(ReadOptions, record.settings.get("recording", {}), "recording")
    truth = reference_trajectory(reference, options)
    document: dict[str, Any] = slam_errors(result, truth)
    if against:
        names = words("--against", against, PEERS)
        source = recording or reference
        if source.suffix == ".tum" or source.suffix == ".txt":
            raise PipelineError(f"peers need the frames: name the recording of {run_path} with --recording")
        indices, poses = compared(result.times_ns, truth)
        frames, intrinsics = frames_at(source, options, result.times_ns[indices])
        if len(frames) != len(poses):
            raise PipelineError(f"{source} is not the recording that {run_path} was made from")
        with common.progress("peers", "peers") as progress, stdout_to_stderr():
            document["peers"] = peer_errors(names, frames, intrinsics, poses, progress)
    common.report(document, _lines(document))


def _lines(document: dict[str, Any]) -> list[str]:
    rows: list[tuple[str, ...]] = [("", "ATE cm", "first-pose cm", "RPE mm", "RPE deg")]
    rows.append(("voxscene", *_figures(document)))
    for name, errors in document.get("peers", {}).items():
        rows.append((errors.get("setting", name), *(("lost",) * 4 if "lost" in errors else _figures(errors))))
    width = max(len(row[0]) for row in rows)
    table = [f"{row[0]:<{width}}  " + "  ".join(f"{cell:>13}" for cell in row[1:]) for row in rows]
    covered = ", ".join(
        f"{share:.0%} of the {float(level):.0%} regions" for level, share in document["coverage"].items()
    )
    return [
        f"{document['frames']} frames compared, {document['lost_frames']} lost",
        *table,
        f"the truth lies in {covered}",
    ]


def _figures(errors: dict[str, Any]) -> tuple[str, ...]:
    degrees = errors["rpe_rotation_rad"] * 57.29577951308232
    return (
        f"{100 * errors['ate_m']:.2f}",
        f"{100 * errors['ate_first_pose_m']:.2f}",
        f"{1000 * errors['rpe_translation_m']:.2f}",
        f"{degrees:.3f}",
    )
