"""The `voxscene` command: finds each subcommand in a file of its own and ends every mistake in one line."""

from __future__ import annotations

import importlib
import keyword
import os
import signal
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any

import click

from pipeline.errors import ConfigError, PipelineError, ProjectError
from pipeline.interruption import end_on_signals
from pipeline.logs import unforeseen
from pipeline.options import GOES_ON
from recordings.errors import RecordingError

COMMANDS = (
    "demo",
    "info",
    "import",
    "synth",
    "calibrate",
    "slam",
    "learn",
    "parse",
    "run",
    "export",
    "review",
    "report",
    "eval",
    "bench",
    "reproduce",
    "doctor",
)
"""Subcommands in the order of a user's work."""

DAMAGED = 3
"""Exit code where part of a damaged input was lost and the rest was used."""

RESUMED = ("demo", "slam", "learn", "parse", "run", "reproduce", "synth challenging")
"""Commands that always go on where they were interrupted; others say so with `goes_on`."""


class Failure(click.ClickException):
    """One clear line on stderr for each mistake, and exit code 1."""

    def show(self, file: Any = None) -> None:
        """Print them."""
        for line in self.message.splitlines():
            click.echo(f"voxscene: {' '.join(line.split())}", file=file, err=True)


class Misuse(Failure):
    """One clear line on stderr and exit code 2."""

    exit_code = 2


class Interrupted(Failure):
    """One clear line on stderr and the exit code that shells give to what Ctrl-C ended."""

    exit_code = 128 + signal.SIGINT


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

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The subcommand that is named; for a misspelt one, the error tells which it may have been."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            near = get_close_matches(args[0], self._members, 1)
            if near:
                raise click.UsageError(f"{error.message} Did you mean {near[0]}?", ctx) from error
            raise

    def invoke(self, ctx: click.Context) -> Any:
        """Run the subcommand; what the user can mend ends as a `Failure`."""
        try:
            return super().invoke(ctx)
        except (click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except ProjectError as error:
            raise Misuse(str(error)) from error
        except ConfigError as error:
            raise Misuse(_one_line(error)) from error
        except (RecordingError, PipelineError) as error:
            raise Failure(_one_line(error)) from error
        except BrokenPipeError:  # nobody reads on, as after `| head`: that is no mistake
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115
            raise SystemExit(1) from None
        except OSError as error:
            raise Failure(f"{error.filename or 'system'}: {error.strerror or error}") from error
        except KeyboardInterrupt as error:
            resumed = _named(ctx) in RESUMED or GOES_ON in ctx.meta
            how = "the same command goes on where it stopped" if resumed else "nothing half-written is left"
            raise Interrupted(f"interrupted; {how}") from error
        except Exception as error:  # one line for the user, the traceback for us
            raise Failure(_one_line(unforeseen(error))) from error


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
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed, as for a job of cron
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        getattr(sys, name).reconfigure(errors="backslashreplace")  # names of files need not be UTF-8
    end_on_signals()
    voxscene()


def _named(ctx: click.Context) -> str:
    """The words that call the subcommand of a group, without the program's name."""
    words = [ctx.invoked_subcommand or ""]
    while ctx.parent is not None:
        words, ctx = [ctx.info_name or "", *words], ctx.parent
    return " ".join(words)


def _one_line(error: object) -> str:
    return " ".join(str(error).split())
