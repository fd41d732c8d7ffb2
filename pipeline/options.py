"""Options that several commands share, and what they are read into."""

from __future__ import annotations

import functools
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from pipeline.errors import ConfigError, PipelineError
from pipeline.progress import Progress, tell

if TYPE_CHECKING:
    from pipeline.config import Settings
    from recordings.options import ReadOptions

Command = TypeVar("Command", bound=Callable[..., Any])


@dataclass(frozen=True, kw_only=True)
class Common:
    """What the user said that holds for any command.

    Attributes:
        as_json: print exactly one JSON document on stdout.
        quiet: no progress, no talk.
        settings: from --config, -s and --seed.
    """

    as_json: bool
    quiet: bool
    settings: Settings

    @property
    def seed(self) -> int:
        """Root of all randomness."""
        from pipeline.config import RunConfig

        return self.settings.section("run", RunConfig).seed

    def progress(self, label: str, unit: str) -> Progress:
        """A progress display that keeps to --quiet."""
        return Progress(label, unit, quiet=self.quiet)

    def report(self, document: Any, lines: Sequence[str]) -> None:
        """Print the result: the document with --json, null for what is not finite, else lines for people."""
        if self.as_json:
            from pipeline.publishing.finite import finite_json

            tell(json.dumps(finite_json(document), allow_nan=False))
        elif not self.quiet:
            tell("\n".join(lines))


class AnyPath(click.Path):
    """A path that is opened later: what cannot be read is a failure, told with where, and no misuse.

    Args:
        file_okay: it may name a file.
        dir_okay: it may name a folder.
    """

    def __init__(self, *, file_okay: bool = True, dir_okay: bool = True) -> None:
        super().__init__(file_okay=file_okay, dir_okay=dir_okay, readable=False, path_type=Path)


class OutputFile(AnyPath):
    """A file that a command writes at its end: what would stand in its way then is told before any work.

    Args:
        suffixes: one of which the name ends in; any where there are none.
    """

    def __init__(self, *suffixes: str) -> None:
        super().__init__(dir_okay=False)
        self._suffixes = suffixes

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path.

        Raises:
            ConfigError: it has another suffix.
            PipelineError: it cannot be written.
        """
        from pipeline.atomic import check_output

        path = Path(str(super().convert(value, param, ctx)))
        if self._suffixes and path.suffix.lower() not in self._suffixes:
            option = param.opts[0] if param else "file"
            raise ConfigError(f"{option} {path}: name a file that ends in {' or '.join(self._suffixes)}")
        check_output(path)
        return path


def common_options(*sections: str, computes: bool = False) -> Callable[[Command], Command]:
    """Give a command --json, --seed, --quiet, --config and -s as one argument `common`.

    Args:
        sections: the sections of the settings file that the command reads.
        computes: whether the command always needs JAX, which is set up before it; a run's stages do so
            themselves, only where there is something to compute.
    """

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def with_common(
            *args: Any,
            as_json: bool,
            quiet: bool,
            verbose: bool,
            seed: int | None,
            config_file: Path | None,
            overrides: tuple[str, ...],
            **kwargs: Any,
        ) -> Any:
            from pipeline.config import RunConfig, Settings
            from pipeline.logs import show_on_stderr

            show_on_stderr(logging.INFO if verbose else logging.WARNING)
            seeding = () if seed is None else (f"run.seed={seed}",)
            settings = Settings.read(config_file, (*overrides, *seeding), ("run", *sections))
            settings.section("run", RunConfig)  # refuses typos where nothing is drawn, too
            common = Common(as_json=as_json, quiet=quiet, settings=settings)
            with common.progress(click.get_current_context().info_name or "voxscene", "") as display:
                display.phase("working")
                if computes:
                    from pipeline.jax_setup import set_up_jax

                    set_up_jax()
                return command(*args, common=common, **kwargs)

        options = [
            click.option("--json", "as_json", is_flag=True, help="Print one JSON document on stdout."),
            click.option("--quiet", "-q", is_flag=True, help="No progress and no text, but for warnings."),
            click.option("--verbose", "-v", is_flag=True, help="Print what goes to log.txt on stderr too."),
            click.option(
                "--seed",
                type=click.IntRange(0, 2**32 - 1),
                help="Root of all randomness; 0 by default.",
            ),
            click.option(
                "--config",
                "config_file",
                type=AnyPath(),
                metavar="FILE.toml",
                help="Settings.",
            ),
            click.option(
                "-s",
                "overrides",
                multiple=True,
                metavar="SECTION.KEY=VALUE",
                help=f"One setting, over the file's. Sections: {', '.join(('run', *sections))}.",
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


@dataclass(frozen=True, kw_only=True)
class RecordingSource:
    """The recording that a command works on, and what its options say about reading it.

    Attributes:
        path: an MCAP file or a rosbag2 folder.
        said: values of `ReadOptions` by name; None says nothing.

    Raises:
        PipelineError: the path is a run folder, whose run.mcap holds views of a few frames.
    """

    path: Path
    said: Mapping[str, Any]

    def __post_init__(self) -> None:
        from pipeline.run_folder import holds_stages

        if holds_stages(self.path):
            raise PipelineError(f"{self.path} is a run, not a recording; name what it was made from")

    @property
    def of_colour_alone(self) -> RecordingSource:
        """The same where no depth is compared: frames of colour will do."""
        return replace(self, said={**self.said, "colour_alone": True})

    def read_options(self, settings: Settings) -> ReadOptions:
        """How it is read: the settings' section `recording`, and over it the command's options.

        Raises:
            ConfigError: a value cannot be used.
        """
        from recordings.options import ReadOptions

        return settings.section("recording", ReadOptions, self.said)


READING = (
    *("depth_topic", "intrinsics", "depth_scale_m", "min_depth_m", "max_depth_m", "mask", "sensor"),
    *("start_s", "end_s", "every"),
)
"""Options of reading, by their names in `ReadOptions`."""


def recording_options(command: Command) -> Command:
    """Give a command the argument REC and the options of reading it as one argument `source`."""

    @functools.wraps(command)
    def with_source(*args: Any, rec: Path, **kwargs: Any) -> Any:
        said = {name: kwargs.pop(name) for name in READING}
        return command(*args, source=RecordingSource(path=rec, said=said), **kwargs)

    return _decorated(with_source, [click.argument("rec", type=AnyPath()), *_reading()])


def several_recordings_options(command: Command) -> Command:
    """Give a command arguments REC... and the options of reading them as one argument `sources`."""

    @functools.wraps(command)
    def with_sources(*args: Any, recs: tuple[Path, ...], **kwargs: Any) -> Any:
        said = {name: kwargs.pop(name) for name in READING}
        return command(*args, sources=[RecordingSource(path=one, said=said) for one in recs], **kwargs)

    argument = click.argument("recs", type=AnyPath(), nargs=-1, required=True, metavar="REC...")
    return _decorated(with_sources, [argument, *_reading()])


def _reading() -> list[Any]:
    """The options of reading a recording."""

    def metres(flag: str, name: str, help_: str) -> Any:
        return click.option(flag, name, type=float, metavar="METRES", help=help_)

    def seconds(flag: str, name: str, help_: str) -> Any:
        return click.option(flag, name, type=float, metavar="SECONDS", help=help_)

    return [
        click.option("--depth-topic", metavar="TOPIC", help="Depth topic, where a recording has several."),
        click.option("--intrinsics", type=Intrinsics(), help="Camera in pixels, over the recorded one."),
        metres(
            "--depth-scale",
            "depth_scale_m",
            "Metres per stored unit; 0.001 for integers and 1 for floats by default.",
        ),
        metres("--min-depth", "min_depth_m", "Nearer depths are ignored."),
        metres("--max-depth", "max_depth_m", "Farther depths are ignored."),
        click.option(
            "--mask",
            type=AnyPath(),
            metavar="FILE.png",
            help="Image that is black where the depth shows what moves with the camera.",
        ),
        click.option(
            "--sensor",
            type=AnyPath(),
            metavar="FILE.toml",
            help="Profile of the sensor, from `calibrate` or a run: noise, distortion, unknown layer.",
        ),
        seconds("--start", "start_s", "From here on, after the first frame."),
        seconds("--end", "end_s", "Up to here, after the first frame."),
        click.option("--every", type=int, metavar="N", help="Every N-th frame; 1 by default."),
    ]


def run_options(command: Command) -> Command:
    """Give a command -o RUN as `run_path` and --force as `force`."""
    options = [
        click.option(
            "-o",
            "--output",
            "run_path",
            type=AnyPath(),
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


LARGEST_PX = 4096
"""Of a picture: graphics drivers draw no larger ones, and what is filmed is held in memory."""


def image_size(text: str) -> tuple[int, int]:
    """Width and height from "640x480".

    Raises:
        ConfigError: the text is no size.
    """
    width, separator, height = text.lower().partition("x")
    if not separator or not width.isdecimal() or not height.isdecimal():
        raise ConfigError(f"--size {text}: write WIDTHxHEIGHT, such as 640x480")
    if not all(1 <= int(side) <= LARGEST_PX for side in (width, height)):
        raise ConfigError(f"--size {text}: both sides must be 1 to {LARGEST_PX} pixels")
    return int(width), int(height)


def numbers(option: str, text: str) -> tuple[float, ...]:
    """Numbers separated by commas.

    Raises:
        ConfigError: something else was written.
    """
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(f"{option} {text}: write numbers separated by commas") from error


def counts(option: str, text: str) -> list[int]:
    """Numbers of things, separated by commas.

    Raises:
        ConfigError: something else was written.
    """
    try:
        found = [int(part) for part in text.split(",")]
    except ValueError as error:
        raise ConfigError(f"{option} {text}: write whole numbers separated by commas") from error
    if min(found) < 1:
        raise ConfigError(f"{option} {text}: every number must be at least 1")
    return found


def words(option: str, text: str, known: Sequence[str]) -> list[str]:
    """Words separated by commas, each one of the known ones.

    Raises:
        PipelineError: a word is unknown.
    """
    given = [word.strip() for word in text.split(",") if word.strip()]
    unknown = [word for word in given if word not in known]
    if unknown:
        raise PipelineError(f"{option}: no {unknown[0]!r}; there are {', '.join(known)}")
    return given


COMMON = ("as_json", "quiet", "verbose", "seed", "config_file", "overrides")
"""Parameters that `common_options` gives to every command."""


def written_flags() -> dict[str, str]:
    """What was written on the command line of the command that runs: its options, by their parameters."""
    context = click.get_current_context()
    return {
        one.name: max(one.opts, key=len)
        for one in context.command.params
        if one.name and context.get_parameter_source(one.name) is click.core.ParameterSource.COMMANDLINE
    }


GOES_ON = "pipeline.goes_on"
"""Key in click's `meta`."""


def goes_on() -> None:
    """Say of the command that runs that, interrupted, it goes on with what it kept when given again."""
    click.get_current_context().meta[GOES_ON] = True


def only_for(whose: str, *names: str) -> None:
    """Refuse options, by their parameters, that would say nothing.

    Raises:
        ConfigError: one was written; it says whose it is.
    """
    written = written_flags()
    for name in names:
        if name in written:
            raise ConfigError(f"{written[name]} is for {whose} only")


def _decorated(command: Any, options: Sequence[Callable[[Any], Any]]) -> Any:
    for option in reversed(options):
        command = option(command)
    return command
