"""The errors that the command line turns into one line and an exit code."""


class PipelineError(Exception):
    """The command cannot do its work; the message says what, where and what to do, in one line."""


class ConfigError(PipelineError):
    """A setting has an unknown name or a value that cannot be used."""
