"""Options that several commands share, and what they are read into."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from pipeline.errors import ConfigError
from recordings.options import ReadOptions

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


class Intrinsics(click.ParamType):
    """`fx,fy,cx,cy` in pixels."""

    name = "fx,fy,cx,cy"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float, float, float]:
        """The four numbers."""
        try:
            fx, fy, cx, cy = (float(number) for number in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not four numbers with commas between them", param, ctx)
        return fx, fy, cx, cy


def recording_options(command: Command) -> Command:
    """Give a command the options of reading a recording as one argument `read_options`."""

    @functools.wraps(command)
    def with_read_options(
        *args: Any,
        depth_topic: str | None,
        intrinsics: tuple[float, float, float, float] | None,
        depth_scale: float | None,
        min_depth: float,
        max_depth: float,
        start: float,
        end: float,
        every: int,
        **kwargs: Any,
    ) -> Any:
        try:
            read_options = ReadOptions(
                depth_topic=depth_topic,
                intrinsics=intrinsics,
                depth_scale_m=depth_scale,
                min_depth_m=min_depth,
                max_depth_m=max_depth,
                start_s=start,
                end_s=end,
                every=every,
            )
        except ValueError as error:
            raise click.UsageError(str(error)) from error
        return command(*args, read_options=read_options, **kwargs)

    def metres(name: str, default: float | None, help_: str) -> Any:
        return click.option(name, type=float, default=default, metavar="METRES", help=help_)

    def seconds(name: str, default: float, help_: str) -> Any:
        return click.option(name, type=float, default=default, metavar="SECONDS", help=help_)

    options = [
        click.option("--depth-topic", metavar="TOPIC", help="The depth, where a recording has several."),
        click.option("--intrinsics", type=Intrinsics(), help="Camera in pixels, over the recorded one."),
        metres("--depth-scale", None, "Metres for a stored 1: as a rule 0.001 for integers, 1 for floats."),
        metres("--min-depth", 0.0, "Nearer depths are ignored."),
        metres("--max-depth", math.inf, "Farther depths are ignored."),
        seconds("--start", 0.0, "From here on, after the first frame."),
        seconds("--end", math.inf, "Up to here, after the first frame."),
        click.option("--every", type=int, default=1, metavar="N", help="Every N-th frame."),
    ]
    return _decorated(with_read_options, options)


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
