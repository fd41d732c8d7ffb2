"""The `voxscene` command: finds each subcommand in a file of its own and ends every mistake in one line."""

from __future__ import annotations

import importlib
import keyword
from collections.abc import Sequence
from typing import Any

import click

from pipeline.errors import ConfigError, PipelineError
from recordings.errors import RecordingError

COMMANDS = (
    "demo",
    "info",
    "import",
    "synth",
    "slam",
    "learn",
    "parse",
    "run",
    "export",
    "review",
    "report",
    "eval",
    "bench",
    "doctor",
)
"""Subcommands in the order of a user's work."""

DAMAGED = 3
"""Exit code where part of a damaged input was lost and the rest was used."""


class Failure(click.ClickException):
    """One clear line on stderr and exit code 1."""

    def show(self, file: Any = None) -> None:
        """Print the line."""
        click.echo(f"voxscene: {' '.join(self.message.split())}", file=file, err=True)


class Misuse(Failure):
    """One clear line on stderr and exit code 2."""

    exit_code = 2


class LazyGroup(click.Group):
    """A group that imports a subcommand only when it is named or listed, and tells mistakes in one line.

    Subcommand NAME is `command` in `PACKAGE.NAME`, or in `PACKAGE.NAME_` where NAME is a word of Python.
    """

    def __init__(self, *args: Any, package: str, members: Sequence[str], **kwargs: Any) -> None:
        """A group of `members` that live in `package`."""
        super().__init__(*args, **kwargs)
        self._package = package
        self._members = list(members)

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Names in the order of a user's work."""
        return self._members

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """The subcommand of that name, imported now."""
        if cmd_name not in self._members:
            return None
        module = f"{cmd_name}_" if keyword.iskeyword(cmd_name) else cmd_name
        return importlib.import_module(f"{self._package}.{module}").command

    def invoke(self, ctx: click.Context) -> Any:
        """Run the subcommand; what the user can mend ends as a `Failure`."""
        try:
            return super().invoke(ctx)
        except ConfigError as error:
            raise Misuse(str(error)) from error
        except (RecordingError, PipelineError) as error:
            raise Failure(str(error)) from error
        except OSError as error:
            raise Failure(f"{error.filename or 'system'}: {error.strerror or error}") from error
        except KeyboardInterrupt as error:
            raise Failure("interrupted; the same command goes on where it stopped") from error


@click.group(
    cls=LazyGroup,
    package="pipeline.commands",
    members=COMMANDS,
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(package_name="voxscene")
def voxscene() -> None:
    """Finds the camera, learns the shapes, parses the scene: from recorded depth, with uncertainty."""


def main() -> None:
    """The console script."""
    voxscene()
