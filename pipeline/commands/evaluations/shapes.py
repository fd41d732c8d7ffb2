"""`voxscene eval shapes`: learned shapes against the true meshes."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.errors import PipelineError
from pipeline.options import Common, common_options


@click.command(name="shapes")
@click.argument("run", type=click.Path(path_type=Path))
@click.option(
    "--truth", type=click.Path(path_type=Path), required=True, metavar="REC", help="Holds the truth."
)
@common_options()
def command(common: Common, run: Path, truth: Path) -> None:
    """Intersection over union of the shapes in RUN with the truth of the recording they were learned from.

    The truth is laid where the run's camera saw it, by all its frames together.

    \b
    solid     occupied or enclosed voxels against the solid object
    shell     their outermost layer against that of the object
    observed  voxels that some ray decided, alone
    """  # noqa: D301  (click reads the \b)
    from pipeline.evaluation.shapes import shape_agreement
    from pipeline.evaluation.truth import RecordedTruth, true_mesh
    from pipeline.publishing.values import RunValues
    from pipeline.run_folder import RunFolder

    values = RunValues.load(RunFolder(run, force=False))
    if values.slam is None or not values.shapes:
        raise PipelineError(f"{run} holds no learned shape; make one with voxscene learn")
    known = RecordedTruth(truth)
    document, lines = {}, [f"{'shape':<20} {'solid':>7} {'shell':>7} {'observed':>9}"]
    for name, shape in values.shapes.items():
        one = known.object_of_shape(name)
        reference_from_object = known.reference_from_object(one, values.slam)
        agreement = shape_agreement(shape, true_mesh(one), reference_from_object)
        document[name] = {**vars(agreement), "pitch_m": shape.pitch_m}
        lines.append(f"{name:<20} {agreement.solid:>7.3f} {agreement.shell:>7.3f} {agreement.observed:>9.3f}")
    common.report(document, lines)
