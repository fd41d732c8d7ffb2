"""`voxscene report`: one page about runs, to keep, print or send."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.options import AnyPath, Common, common_options


@click.command(name="report")
@click.argument("runs", metavar="RUN|PROJECT...", nargs=-1, required=True, type=AnyPath())
@click.option(
    "-o",
    "--output",
    type=AnyPath(dir_okay=False),
    default="report.html",
    show_default=True,
    metavar="FILE.html",
)
@common_options()
def command(common: Common, runs: tuple[Path, ...], output: Path) -> None:
    """One HTML page about runs, to keep or send.

    Figures side by side, what calls for care, pictures, tables and settings. It holds everything itself and
    opens without a network. Of a project, every recording's run is told. It takes the place of an earlier
    report, and of no other file.
    """
    from pipeline.atomic import check_output, check_replaced, write_text
    from pipeline.errors import ConfigError
    from pipeline.report.run_report import is_report, report

    check_output(output)
    if output.suffix.lower() not in (".html", ".htm", ""):
        raise ConfigError(f"--output {output}: a report is an HTML page, name a file that ends with .html")
    check_replaced(output, "report of voxscene", is_report)
    with common.progress("report", "runs") as progress:
        page = report(runs, progress)
    write_text(output, page.html())
    megabytes = output.stat().st_size / 1e6
    common.report({"report": str(output), "megabytes": megabytes}, [f"wrote {output} ({megabytes:.1f} MB)"])
