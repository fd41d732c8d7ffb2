"""`voxscene eval shapes`: learned shapes against the true meshes, or against depth held back."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pipeline.errors import ConfigError, PipelineError
from pipeline.options import AnyPath, Common, common_options

if TYPE_CHECKING:
    from pipeline.run_folder import RunFolder
    from recordings.types import Trajectory
    from shapes.prior import ShapePrior
    from slam.result import SlamResult

COLUMNS = (
    "intersection over union with the truth, 1 at best: solid, the body with the inside that no ray sees;",
    "shell, its outermost voxels; observed, the voxels that rays decided. Walls as thin as voxels lower it.",
)
"""What the columns of the table mean."""


@click.command(name="shapes")
@click.argument("run", type=AnyPath())
@click.option("--truth", type=AnyPath(), metavar="REC", help="Holds the true meshes.")
@click.option(
    "--held-back",
    type=AnyPath(),
    metavar="REC",
    help="The recording itself: compare with the frames that were not learned from (-s learn.views=N).",
)
@common_options(computes=True)
def command(common: Common, run: Path, truth: Path | None, held_back: Path | None) -> None:
    """Intersection over union of the shapes in RUN with the truth.

    The truth is that of the recording they were learned from, laid where the run's camera saw it, by all its
    frames together. Without a truth: how far, along the rays, the learned surfaces lie from depth that
    learning did not get.

    \b
    solid     occupied or enclosed voxels against the solid object
    shell     their outermost layer against that of the object
    observed  voxels that some ray decided, alone
    """  # noqa: D301  (click reads the \b)
    from pipeline.evaluation.same_recording import check_truth
    from pipeline.publishing.values import RunValues
    from pipeline.run_folder import RunFolder, check_one_recording

    if truth is None and held_back is None:
        raise ConfigError("say what to compare with: --truth REC or --held-back REC")
    check_one_recording(run)
    folder = RunFolder(run, force=False)
    values = RunValues.load(folder)
    if not values.shapes:
        raise PipelineError(f"{run} holds no learned shape; make one with voxscene learn")
    for source in filter(None, (truth, held_back)):
        check_truth(folder, source)
    document: dict[str, Any] = {name: {"pitch_m": one.pitch_m} for name, one in values.shapes.items()}
    lines: list[str] = []
    if truth is not None:
        lines.append(f"{'shape':<20} {'solid':>7} {'shell':>7} {'observed':>9}")
        for name, shape in values.shapes.items():
            document[name] |= _agreement(folder, name, shape, _path(folder, name, values.slam, truth), truth)
            figures = (document[name][key] for key in ("solid", "shell", "observed"))
            lines.append(f"{name:<20} {'{:>7.3f} {:>7.3f} {:>9.3f}'.format(*figures)}")
        lines += COLUMNS
    if held_back is not None:
        lines.append(f"{'shape':<20} {'held-back frames':>16} {'median mm':>10} {'90% mm':>8}")
        for name, shape in values.shapes.items():
            path = _path(folder, name, values.slam, held_back)
            found = _held_back(folder, name, shape, path, held_back)
            document[name]["held_back"] = found
            sizes = f"{1000 * found['median_m']:>10.2f} {1000 * found['quantile_90_m']:>8.2f}"
            lines.append(f"{name:<20} {found['frames']:>16} {sizes}")
    common.report(document, lines)


def _path(folder: RunFolder, name: str, slam: SlamResult | None, recording: Path) -> Trajectory:
    """The camera's path that a shape was learned with, in the run's reference frame."""
    from pipeline.stages.learn import recorded_path
    from recordings.options import ReadOptions

    record = folder.record(f"learn/{name}")
    if slam is not None and (record is None or "slam" in record.uses):
        return slam.tracked_path
    recorded = recorded_path(recording, record.read_options if record else ReadOptions())
    if recorded is None:
        raise PipelineError(f"{recording} has no recorded poses, with which {name} was learned")
    return recorded


def _agreement(
    folder: RunFolder, name: str, shape: ShapePrior, path: Trajectory, truth: Path
) -> dict[str, float]:
    from pipeline.evaluation.same_recording import truth_options
    from pipeline.evaluation.shapes import shape_agreement
    from pipeline.evaluation.truth import RecordedTruth, true_mesh

    known = RecordedTruth(truth, truth_options(folder, f"learn/{name}"))
    one = known.object_of_shape(name)
    return vars(shape_agreement(shape, true_mesh(one), known.reference_from_object(one, path)))


def _held_back(
    folder: RunFolder, name: str, shape: ShapePrior, path: Trajectory, recording: Path
) -> dict[str, Any]:
    from pipeline.config import build
    from pipeline.evaluation.held_back import held_back_errors, held_back_times
    from pipeline.evaluation.trajectories import FramesAt
    from recordings.options import ReadOptions
    from shapes.learning.config import LearnConfig

    record = folder.record(f"learn/{name}")
    settings = {} if record is None else record.settings
    times_ns = held_back_times(path, build(LearnConfig, settings.get("learn", {}), "learn"))
    if not len(times_ns):
        raise PipelineError(f"{name} was learned from every frame; hold some back with -s learn.views=N")
    frames = FramesAt(recording, record.read_options if record else ReadOptions(), times_ns)
    found = held_back_errors(shape, frames, frames.intrinsics, path)
    if not found.frames:
        raise PipelineError(f"no frame of {recording} that was held back shows {name}")
    return vars(found)
