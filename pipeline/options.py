"""Options that several commands share, and what they are read into."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from pipeline.errors import ConfigError

if TYPE_CHECKING:
    from pipeline.config import Settings
    from pipeline.progress import Progress

Command = TypeVar("Command", bound=Callable[..., Any])


@dataclass(frozen=True, kw_only=True)
class Common:
    """What the user said that holds for any command.

    Attributes:
        as_json: print exactly one JSON document on stdout.
        quiet: no progress, no talk.
        seed: root of all randomness.
        settings: from --config and -s.
    """

    as_json: bool
    quiet: bool
    seed: int
    settings: Settings

    def progress(self, label: str, unit: str) -> Progress:
        """A progress display that keeps to --quiet."""
        from pipeline.progress import Progress

        return Progress(label, unit, quiet=self.quiet)

    def report(self, document: Any, lines: Sequence[str]) -> None:
        """Print the result: the document with --json, else the lines for people."""
        if self.as_json:
            click.echo(json.dumps(document, allow_nan=False))
        elif not self.quiet:
            click.echo("\n".join(lines))


def common_options(*sections: str) -> Callable[[Command], Command]:
    """Give a command --json, --seed, --quiet, --config and -s as one argument `common`.

    Args:
        sections: the sections of the settings file that the command reads.
    """

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def with_common(
            *args: Any,
            as_json: bool,
            quiet: bool,
            seed: int,
            config_file: Path | None,
            overrides: tuple[str, ...],
            **kwargs: Any,
        ) -> Any:
            from pipeline.config import Settings

            settings = Settings.read(config_file, overrides, sections)
            common = Common(as_json=as_json, quiet=quiet, seed=seed, settings=settings)
            return command(*args, common=common, **kwargs)

        options = [
            click.option("--json", "as_json", is_flag=True, help="Print one JSON document on stdout."),
            click.option("--quiet", "-q", is_flag=True, help="No progress and no text."),
            click.option(
                "--seed",
                type=click.IntRange(0, 2**32 - 1),
                default=0,
                show_default=True,
                help="Root of all randomness.",
            ),
            click.option(
                "--config",
                "config_file",
                type=click.Path(path_type=Path),
                metavar="FILE.toml",
                help="Settings.",
            ),
            click.option(
                "-s",
                "overrides",
                multiple=True,
                metavar="SECTION.KEY=VALUE",
                help=f"One setting, over the file's. Sections: {', '.join(sections)}.",
            ),
        ]
        return _decorated(with_common, options)

    return decorate


def run_options(command: Command) -> Command:
    """Give a command -o RUN as `run_path` and --force as `force`."""
    options = [
        click.option(
            "-o",
            "--output",
            "run_path",
            type=click.Path(path_type=Path),
            required=True,
            metavar="RUN",
            help="Run folder; made if it is not there, resumed if it is.",
        ),
        click.option(
            "--force",
            is_flag=True,
            help="Begin anew a RUN made from other inputs, and compute everything again.",
        ),
    ]
    return _decorated(command, options)


def image_size(text: str) -> tuple[int, int]:
    """Width and height from "640x480".

    Raises:
        ConfigError: the text is no size.
    """
    width, separator, height = text.lower().partition("x")
    if not separator or not width.isdecimal() or not height.isdecimal():
        raise ConfigError(f"--size {text}: write WIDTHxHEIGHT, such as 640x480")
    return int(width), int(height)


def numbers(option: str, text: str, count: int | None = None) -> tuple[float, ...]:
    """Numbers separated by commas, `count` of them where it is given.

    Raises:
        ConfigError: something else was written.
    """
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(f"{option} {text}: write numbers separated by commas") from error
    if count is not None and len(values) != count:
        raise ConfigError(f"{option} {text}: {count} numbers are needed, got {len(values)}")
    return values


def _decorated(command: Any, options: Sequence[Callable[[Any], Any]]) -> Any:
    for option in reversed(options):
        command = option(command)
    return command
