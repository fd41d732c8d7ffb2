"""What can be exported: a learned shape, a folder of them, a run, or a project's run with all of these."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import trimesh

from pipeline.errors import PipelineError
from pipeline.export.model_export import ExportOptions, export_models
from pipeline.export.models import learned_model
from pipeline.export.run_export import export_run, held_formats
from pipeline.publishing.values import RunValues
from pipeline.run_folder import RunFolder, holds_stages, is_project


def export(
    source: Path,
    formats: Sequence[str],
    out: Path,
    options: ExportOptions,
    room: trimesh.Trimesh | None = None,
) -> list[Path]:
    """Write whatever `source` is, in every format asked for.

    Of a project's run, the learned shapes go to OUT/shapes and each recording to OUT/STEM, in those of the
    formats for which it holds something.

    Args:
        source: a shape's file, a folder of them, or a run.
        formats: of `MODEL_FORMATS`.
        out: folder.
        options: how shapes are written.
        room: of a run, triangles of its room instead of points.

    Returns:
        The files written.

    Raises:
        PipelineError: the source holds nothing to export, or a file is there that says something else.
    """
    if source.is_file() or not source.exists():
        return export_models(
            [learned_model(source, shells=options.shells, unseen=options.unseen)], formats, out, options
        )
    if is_project(source):
        written: list[Path] = []
        if shapes := sorted((source / "shapes").glob("*.npz")):
            models = [learned_model(path, shells=options.shells, unseen=options.unseen) for path in shapes]
            written += export_models(models, formats, out / "shapes", options)
        for run in filter(is_run, sorted((source / "recordings").iterdir())):
            if held := held_formats(run, formats):
                written += export_run(run, held, out / run.name, options)
        if not written:
            raise PipelineError(
                f"no recording's run in {source} holds anything for --format {','.join(formats)}"
            )
        return written
    if is_run(source):
        return export_run(source, formats, out, options, room)
    if shapes := sorted(source.glob("*.npz")):
        return export_models(
            [learned_model(path, shells=options.shells, unseen=options.unseen) for path in shapes],
            formats,
            out,
            options,
        )
    raise PipelineError(
        f"{source} is neither a learned shape (NAME.npz), a folder of them, nor a run; "
        "make a run with voxscene slam, learn, parse or run"
    )


def shape_names(source: Path) -> set[str]:
    """Names of the shapes that an export of `source` writes."""
    if is_project(source):
        runs = filter(is_run, (source / "recordings").iterdir())
        return {path.stem for path in (source / "shapes").glob("*.npz")}.union(*map(shape_names, runs))
    if is_run(source):
        values = RunValues.load(RunFolder(source, force=False))
        return {*values.shapes, *(values.surfaces.shape_names.values() if values.surfaces else ())}
    return {path.stem for path in source.glob("*.npz")} if source.is_dir() else {source.stem}


def is_run(folder: Path) -> bool:
    """Whether a folder is the run of one recording."""
    return holds_stages(folder) and not is_project(folder)
