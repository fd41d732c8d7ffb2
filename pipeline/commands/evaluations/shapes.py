"""`voxscene eval shapes`: learned shapes against the true meshes, or against depth held back."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pipeline.errors import ConfigError, PipelineError
from pipeline.options import AnyPath, Common, common_options

if TYPE_CHECKING:
    from pipeline.run_folder import RunFolder
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
@common_options()
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
    from pipeline.run_folder import RunFolder

    if truth is None and held_back is None:
        raise ConfigError("say what to compare with: --truth REC or --held-back REC")
    folder = RunFolder(run, force=False)
    values = RunValues.load(folder)
    if values.slam is None or not values.shapes:
        raise PipelineError(f"{run} holds no learned shape; make one with voxscene learn")
    for source in filter(None, (truth, held_back)):
        check_truth(folder, source)
    document: dict[str, Any] = {name: {"pitch_m": one.pitch_m} for name, one in values.shapes.items()}
    lines: list[str] = []
    if truth is not None:
        lines.append(f"{'shape':<20} {'solid':>7} {'shell':>7} {'observed':>9}")
        for name, shape in values.shapes.items():
            document[name] |= _agreement(name, shape, values.slam, truth)
            figures = (document[name][key] for key in ("solid", "shell", "observed"))
            lines.append(f"{name:<20} {'{:>7.3f} {:>7.3f} {:>9.3f}'.format(*figures)}")
        lines += COLUMNS
    if held_back is not None:
        lines.append(f"{'shape':<20} {'held-back frames':>16} {'median mm':>10} {'90% mm':>8}")
        for name, shape in values.shapes.items():
            found = _held_back(folder, name, shape, values.slam, held_back)
            document[name]["held_back"] = found
            sizes = f"{1000 * found['median_m']:>10.2f} {1000 * found['quantile_90_m']:>8.2f}"
            lines.append(f"{name:<20} {found['frames']:>16} {sizes}")
    common.report(document, lines)


def _agreement(name: str, shape: ShapePrior, slam: SlamResult, truth: Path) -> dict[str, float]:
    from pipeline.evaluation.shapes import shape_agreement
    from pipeline.evaluation.truth import RecordedTruth, true_mesh

    known = RecordedTruth(truth)
    one = known.object_of_shape(name)
    return vars(shape_agreement(shape, true_mesh(one), known.reference_from_object(one, slam)))


def _held_back(
    folder: RunFolder, name: str, shape: ShapePrior, slam: SlamResult, recording: Path
) -> dict[str, Any]:
    from pipeline.config import build
    from pipeline.evaluation.held_back import held_back_errors, held_back_times
    from pipeline.evaluation.trajectories import FramesAt
    from recordings.options import ReadOptions
    from shapes.learning.config import LearnConfig

    record = folder.record(f"learn/{name}")
    settings = {} if record is None else record.settings
    times_ns = held_back_times(slam, build(LearnConfig, settings.get("learn", {}), "learn"))
    if not len(times_ns):
        raise PipelineError(f"{name} was learned from every frame; hold some back with -s learn.views=N")
    options = build(ReadOptions, settings.get("recording", {}), "recording")
    frames = FramesAt(recording, options, times_ns)
    found = held_back_errors(shape, frames, frames.intrinsics, slam)
    if not found.frames:
        raise PipelineError(f"no frame of {recording} that was held back shows {name}")
    return vars(found)
