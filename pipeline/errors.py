"""The errors that the command line turns into one line and an exit code."""

from collections.abc import Sequence


class PipelineError(Exception):
    """The command cannot do its work; the message says what, where and what to do, in one line."""


class ConfigError(PipelineError):
    """A setting has an unknown name or a value that cannot be used."""


class ProjectError(ConfigError):
    """What is wrong with a project, found before any of its work began: one line for each mistake."""

    def __init__(self, lines: Sequence[str]) -> None:
        super().__init__("\n".join(" ".join(line.split()) for line in lines))
