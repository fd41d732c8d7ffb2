"""Sensor profiles as files: a run's value, and what a user gives to other runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tomli_w

from pipeline.atomic import write_text
from recordings.errors import RecordingError
from recordings.sensor_profile import SensorProfile, load_sensor_profile


@dataclass(frozen=True)
class StoredProfile:
    """A profile in a file of the format that users give.

    Attributes:
        profile: what is known.
    """

    profile: SensorProfile

    @property
    def text(self) -> str:
        """The file's content."""
        return tomli_w.dumps(self.profile.table())

    def save(self, path: Path) -> None:
        """Write it, whole or not at all.

        Raises:
            PipelineError: the file cannot be written.
        """
        write_text(path, self.text)

    @classmethod
    def load(cls, path: Path) -> StoredProfile:
        """Read what `save` wrote.

        Raises:
            ValueError: the file is damaged.
        """
        try:
            return cls(load_sensor_profile(path))
        except RecordingError as error:
            raise ValueError(str(error)) from error


def is_profile(path: Path) -> bool:
    """Whether a file is a sensor profile that can be read."""
    try:
        load_sensor_profile(path)
    except RecordingError:
        return False
    return True
