"""`voxscene run`: a project of many recordings through all stages, resumable."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import click

from pipeline.damage import report_damage
from pipeline.executors import Workers
from pipeline.options import AnyPath, Common, common_options

if TYPE_CHECKING:
    from pipeline.project_run import Row


@click.command(name="run")
@click.argument("project_file", type=AnyPath(), metavar="PROJECT.toml")
@click.option(
    "-o",
    "--output",
    "run_path",
    type=AnyPath(),
    metavar="RUN",
    help="Run folder; PROJECT.run next to the project file by default.",
)
@click.option("--force", is_flag=True, help="Compute everything again.")
@click.option(
    "--workers",
    type=Workers(),
    help="So many recordings side by side, one core each, or on a Dask cluster that sees the same files; one "
    "by one with all cores unless given.",
)
@click.option(
    "--keep-going", is_flag=True, help="Run the others where the check of the project finds mistakes."
)
@click.option("--stop-at-failure", is_flag=True, help="Begin no further recording once one has failed.")
@common_options("recording", "slam", "learn", "parse")
@click.pass_context
def command(
    ctx: click.Context,
    common: Common,
    project_file: Path,
    run_path: Path | None,
    force: bool,
    workers: int | str | None,
    keep_going: bool,
    stop_at_failure: bool,
) -> None:
    """Run every recording of PROJECT.toml through its stages.

    What is done and unchanged stays. The whole project is looked over first; then a recording that fails
    costs no other one: it stands in the table at the end and in summary.json, and the exit code is 1.

    \b
    [[recording]]
    path = "mug.mcap"        # relative to the project file; several at once: "recordings/*.mcap"
    stage = "learn"          # slam, learn or parse
    name = "mug"             # of the learned shape
    [[recording]]
    path = "table.mcap"
    stage = "parse"
    objects = ["mug"]        # every learned shape unless given

    Sections of settings, such as [slam], hold for all recordings.
    """  # noqa: D301  (click reads the \b)
    from pipeline.errors import ProjectError
    from pipeline.project import UnreadableEntries, read_project
    from pipeline.project_check import project_mistakes
    from pipeline.project_run import run_project

    folder = run_path or project_file.with_suffix(".run")
    try:
        project = read_project(project_file)
    except UnreadableEntries as error:
        raise ProjectError([*error.lines, *project_mistakes(error.rest, folder, common)]) from error
    mistakes = project_mistakes(project, folder, common)
    if mistakes and not keep_going:
        raise ProjectError(
            [*mistakes, "nothing was begun; with --keep-going the others are run all the same"]
        )
    rows = run_project(project, folder, common, force=force, workers=workers, stop_at_failure=stop_at_failure)
    common.report(
        json.loads((folder / "summary.json").read_text()),
        [*_table(rows), f"look at it with: voxscene review {quote(str(folder))}"],
    )
    damaged = max((report_damage(row.path, row.damage) for row in rows), default=0)
    ctx.exit(1 if any(row.failure for row in rows) or len(rows) < len(project.recordings) else damaged)


def _table(rows: Sequence[Row]) -> list[str]:
    """How it ended for each recording, and why."""
    width = max((len(row.stem) for row in rows), default=0)
    lines = []
    for row in rows:
        state = f"failed: {row.failure}" if row.failure else f"{row.stage} done, {row.seconds:.1f} s"
        lines.append(f"{row.stem:<{width}}  {state}")
        lines += [f"{'':<{width}}  {warning}" for warning in row.warnings]
    failed = sum(row.failure is not None for row in rows)
    return [*lines, f"{len(rows) - failed} of {len(rows)} recordings done"]
