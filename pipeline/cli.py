"""The `voxscene` command: finds each subcommand in a file of its own and ends every mistake in one line."""

from __future__ import annotations

import importlib
import sys

import click

from pipeline.errors import PipelineError
from recordings.errors import RecordingError

COMMANDS = ("doctor",)
"""Subcommands in the order of a user's work; `voxscene NAME` is `command` in `pipeline.commands.NAME`."""


class LazyGroup(click.Group):
    """A group that imports a subcommand only when it is named or listed."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Names in the order of a user's work."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """The subcommand of that name, imported now."""
        if cmd_name not in COMMANDS:
            return None
        return importlib.import_module(f"pipeline.commands.{cmd_name}").command


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="voxscene")
def voxscene() -> None:
    """Finds the camera, learns the shapes, parses the scene: from recorded depth, with uncertainty."""


def main() -> None:
    """Run the command line; the user's mistakes end in one line on stderr and exit code 1."""
    try:
        voxscene()
    except (RecordingError, PipelineError) as error:
        click.echo(f"voxscene: {error}", err=True)
        sys.exit(1)
