"""`voxscene doctor`: is everything here that the program needs?"""

from __future__ import annotations

import click

from pipeline.options import Common, common_options


@click.command(name="doctor")
@common_options()
@click.pass_context
def command(ctx: click.Context, common: Common) -> None:
    """Versions, JAX device and missing system libraries.

    Each library with the package that holds it. Ends with exit code 1 where something that every command
    needs is missing.
    """
    from pipeline.quiet_stdout import stdout_to_stderr
    from pipeline.system_check import checks

    with stdout_to_stderr():
        found = checks()
    lines = [f"{'!' if one.remedy else ' '} {one.name}: {one.found}" for one in found]
    lines += [f"to mend {one.name}: {one.remedy}" for one in found if one.remedy]
    common.report([vars(one) for one in found], lines)
    ctx.exit(int(any(one.remedy and one.required for one in found)))
