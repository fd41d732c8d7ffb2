"""A recording as its user names it: one MCAP file, or a rosbag2 folder of several."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from recordings.mcap_files.mcap_file import McapFile, Message, Topic
from recordings.types import Damage


class Bag:
    """The files of a recording, read one after the other as if they were one.

    Raises:
        RecordingError: there is no such recording, or a file of it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files = (McapFile(path),)

    @property
    def topics(self) -> list[Topic]:
        """What the recording's channels carry, by name; a topic with two schemas stands there twice."""
        return sorted({topic for file in self.files for topic in file.topics}, key=lambda topic: topic.name)

    @property
    def damage(self) -> Damage:
        """What was lost of what has been read so far."""
        return Damage(
            lost_messages=sum(file.lost_messages for file in self.files),
            lost_chunks=sum(len(file.losses) for file in self.files),
            verified=all(file.verified for file in self.files),
        )

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """The messages of the named topics, or of all."""
        for file in self.files:
            yield from file.messages(topics)
