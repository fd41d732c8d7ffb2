"""`voxscene eval slam`: a run's trajectory against the truth, and against other trackers."""

from __future__ import annotations

import shlex
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pipeline.errors import PipelineError
from pipeline.options import AnyPath, Common, common_options
from pipeline.peers import PEERS

if TYPE_CHECKING:
    from pipeline.evaluation.trajectories import ComparedTrajectory
    from recordings.options import ReadOptions

OURS = "voxscene"
"""Name of the run's own trajectory."""
REFERENCE = "reference"
"""Name under which the truth stands in pictures and views."""
ESTIMATES = (".tum", ".txt")
"""Suffixes of files that hold a trajectory."""


@click.command(name="slam")
@click.argument("run_path", metavar="RUN", type=AnyPath())
@click.option(
    "--reference",
    required=True,
    type=AnyPath(),
    metavar="TUM|MCAP",
    help="The truth: a TUM file, or a recording with poses.",
)
@click.option(
    "--against",
    metavar="PEER|FILE.tum,...",
    help=f"Also others: peers, run on the same frames ({', '.join(PEERS)}), or their TUM files.",
)
@click.option(
    "--recording",
    type=AnyPath(),
    metavar="REC",
    help="The frames for the peers, where the reference is not the recording itself.",
)
@click.option(
    "-o",
    "--output",
    type=AnyPath(file_okay=False),
    metavar="DIR",
    help="Write reference.tum, estimate.tum, errors.csv, error.png, path.png and errors.rrd.",
)
@common_options(computes=True)
def command(
    run_path: Path,
    reference: Path,
    against: str | None,
    recording: Path | None,
    output: Path | None,
    common: Common,
) -> None:
    """Trajectory errors of RUN and the coverage of its regions.

    Aligned (ATE), from the first pose, and of each step (RPE). Each peer is run with several settings, and
    its best result counts. With -o, evo and other programs can go on from what is written.
    """
    from pipeline.evaluation.error_files import check_comparison, write_comparison
    from pipeline.evaluation.same_recording import check_truth
    from pipeline.evaluation.trajectories import (
        ComparedTrajectory,
        compared_file,
        compared_run,
        reference_trajectory,
        slam_errors,
    )
    from pipeline.run_folder import RunFolder, check_one_recording
    from slam.result import SlamResult

    if output:
        check_comparison(output)
    check_one_recording(run_path)
    run = RunFolder(run_path, force=False)
    record = run.record("slam")
    if record is None:
        raise PipelineError(
            f"{run_path} holds no finished slam; make it with: voxscene slam REC -o {run_path}"
        )
    peers, files = _others(against)
    result = SlamResult.load(run.value_path("slam"))
    options = record.read_options
    truth = reference_trajectory(reference, options)
    ours = compared_run(result, truth)
    check_truth(run, reference)
    found: dict[str, ComparedTrajectory | str] = {}
    if peers:
        found = _run_peers(peers, recording or reference, options, ours, run_path, common)
    found |= {path.name: compared_file(path, truth) for path in files}
    document: dict[str, Any] = slam_errors(result, truth)
    if against:
        document["peers"] = {name: _peer_document(one) for name, one in found.items()}
    lines = _lines(document)
    if output:
        others = [one for one in found.values() if isinstance(one, ComparedTrajectory)]
        written = write_comparison(output, result, ours, others)
        document["files"] = [str(path) for path in written]
        two = shlex.join(document["files"][:2])
        lines += [*document["files"], f"evo: evo_ape tum {two} --align"]
    common.report(document, lines)


def _others(against: str | None) -> tuple[list[str], list[Path]]:
    """Peers to run, and files of other estimates, from what stands between the commas.

    Raises:
        PipelineError: a word is neither, or two trajectories have one name.
    """
    peers: list[str] = []
    files: list[Path] = []
    for word in filter(None, (part.strip() for part in (against or "").split(","))):
        if word.replace("_", "-") in PEERS:
            peers.append(word.replace("_", "-"))
        elif Path(word).suffix in ESTIMATES:
            files.append(Path(word))
        else:
            raise PipelineError(
                f"--against: no {word!r}; there are {', '.join(PEERS)}, or files {' and '.join(ESTIMATES)}"
            )
    names = [OURS, REFERENCE, *(path.stem for path in files)]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise PipelineError(f"--against: two trajectories are named {twice}; give one file another name")
    return peers, files


def _run_peers(
    names: list[str],
    source: Path,
    options: ReadOptions,
    ours: ComparedTrajectory,
    run_path: Path,
    common: Common,
) -> dict[str, ComparedTrajectory | str]:
    """Peers on the frames of a recording that were compared.

    Raises:
        PipelineError: the recording is not the run's.
    """
    from pipeline.evaluation.trajectories import FramesAt, peer_runs
    from pipeline.quiet_stdout import stdout_to_stderr

    if source.suffix in ESTIMATES:
        raise PipelineError(f"peers need the frames: name the recording of {run_path} with --recording")
    frames = FramesAt(source, options, ours.times_ns)
    if len(frames) != len(ours.times_ns):
        raise PipelineError(f"{source} is not the recording that {run_path} was made from")
    with common.progress("peers", "peers") as progress, stdout_to_stderr():
        return peer_runs(names, frames, frames.intrinsics, ours, progress)


def _peer_document(one: ComparedTrajectory | str) -> dict[str, Any]:
    if isinstance(one, str):
        return {"lost": True, "problem": one}
    return {"setting": one.name, **asdict(one.errors)}


def _lines(document: dict[str, Any]) -> list[str]:
    rows: list[tuple[str, ...]] = [("", "ATE cm", "first-pose cm", "RPE mm", "RPE deg")]
    rows.append((OURS, *_figures(document)))
    if "found" in document:
        rows.append(("  without lost frames", *_figures(document["found"])))
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
