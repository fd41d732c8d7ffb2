"""`voxscene run`: a project of many recordings through all stages, resumable."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.damage import report_damage
from pipeline.options import Common, common_options


@click.command(name="run")
@click.argument("project_file", type=click.Path(path_type=Path), metavar="PROJECT.toml")
@click.option(
    "-o",
    "--output",
    "run_path",
    type=click.Path(path_type=Path),
    metavar="RUN",
    help="Run folder; PROJECT.run beside the project file unless given.",
)
@click.option("--force", is_flag=True, help="Compute everything again.")
@common_options("recording", "slam", "learn", "parse")
@click.pass_context
def command(
    ctx: click.Context, common: Common, project_file: Path, run_path: Path | None, force: bool
) -> None:
    """Run every recording of PROJECT.toml through its stages.

    What is done and unchanged stays.

    \b
    [[recording]]
    path = "mug.mcap"        # relative to the project file
    stage = "learn"          # slam, learn or parse
    name = "mug"             # of the learned shape
    [[recording]]
    path = "table.mcap"
    stage = "parse"
    objects = ["mug"]        # every learned shape unless given

    Sections of settings, such as [slam], hold for all recordings.
    """  # noqa: D301  (click reads the \b)
    import json

    from pipeline.project import read_project
    from pipeline.project_run import run_project

    project = read_project(project_file)
    folder = run_path or project_file.with_suffix(".run")
    damage = run_project(project, folder, common, force=force)
    summary = json.loads((folder / "summary.json").read_text())
    lines = [f"{stem}: {', '.join(stages)}" for stem, stages in summary["recordings"].items()]
    common.report(summary, [*lines, f"look at it with: voxscene review {folder}"])
    ctx.exit(max(report_damage(path, lost) for path, lost in damage.items()))
