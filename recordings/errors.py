"""The one error that reading or writing a recording raises."""


class RecordingError(Exception):
    """A recording cannot be used; the message says what, where and what to do, in one line."""
