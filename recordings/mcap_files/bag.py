"""A recording as its user names it: one MCAP file, or a rosbag2 folder of several."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recordings.errors import RecordingError
from recordings.mcap_files.attachments import Attachment
from recordings.mcap_files.mcap_file import McapFile, Message, Topic
from recordings.mcap_files.sources import ZSTD_SUFFIXES
from recordings.settings import TEXT
from recordings.types import Damage

_SUFFIXES = (".mcap", *(f".mcap{suffix}" for suffix in ZSTD_SUFFIXES))
_SPLIT_NUMBER = re.compile(r"_(\d+)$")
_METADATA = "metadata.yaml"
_LARGEST_METADATA = 1 << 24


class Bag:
    """The files of a recording, read one after the other as if they were one.

    Raises:
        RecordingError: there is no such recording, or a file of it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        parts = _parts_of_folder(path) if path.is_dir() else [_Part(path)]
        self._missing = [part for part in parts if not part.path.is_file() and path.is_dir()]
        self.files = tuple(McapFile(part.path) for part in parts if part not in self._missing)
        if not self.files:
            raise RecordingError(f"{path} has none of the files that its metadata.yaml lists")

    def keep_blocks(self, size: int) -> None:
        """Keep so many bytes of what is read, for readers of several topics that go on side by side."""
        for file in self.files:
            file.cache.size = size

    @property
    def topics(self) -> list[Topic]:
        """What the recording's channels carry, by name; a topic with two schemas stands there twice."""
        return sorted({topic for file in self.files for topic in file.topics}, key=lambda topic: topic.name)

    @property
    def attachments(self) -> list[Attachment]:
        """The files that the recording carries beside its messages."""
        return [attachment for file in self.files for attachment in file.index.attachments]

    @property
    def damage(self) -> Damage:
        """What was lost of what has been read so far; a missing file counts as a chunk."""
        return Damage(
            lost_messages=sum(file.lost_messages for file in self.files)
            + sum(part.messages for part in self._missing),
            lost_chunks=sum(len(file.losses) for file in self.files) + len(self._missing),
            verified=all(file.verified for file in self.files),
        )

    @property
    def problems(self) -> list[str]:
        """A sentence for a person on each loss."""
        damaged = [
            f"{file.path.name}: what stands at byte {loss.offset} {loss.reason}"
            for file in self.files
            for loss in file.losses
        ]
        return damaged + [f"{part.path.name}: the file is missing" for part in self._missing]

    def log_steps_back_s(self, topic: str) -> list[float]:
        """Where a topic's log time steps back within a file, in seconds after its first block there."""
        return [seconds for file in self.files for seconds in file.log_steps_back_s(topic)]

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """The messages of the named topics, or of all."""
        for file in self.files:
            yield from file.messages(topics)


def files_of(path: Path) -> list[Path]:
    """The files that a recording is read from; of a folder those that are there, with its metadata.

    Raises:
        RecordingError: the folder holds no recording.
    """
    if not path.is_dir():
        return [path]
    files = [part.path for part in _parts_of_folder(path)]
    return [file for file in (*files, path / _METADATA) if file.is_file()]


@dataclass(frozen=True)
class _Part:
    """One file of a recording, and how many messages its folder's metadata say it holds."""

    path: Path
    messages: int = 0


def _parts_of_folder(folder: Path) -> list[_Part]:
    """The files of a rosbag2 folder, in the order of its metadata or, without them, of their numbers."""
    listed = _listed_parts(folder)
    if listed:
        return listed
    found = sorted(
        (path for path in folder.iterdir() if path.name.endswith(_SUFFIXES)),
        key=lambda path: (_stem(path), _number(path), path.name),
    )
    if not found:
        raise RecordingError(f"{folder} holds no MCAP file; data of other programs: voxscene import --help")
    if len({_stem(path) for path in found}) > 1:
        names = ", ".join(path.name for path in found[:4])
        raise RecordingError(f"{folder} holds several recordings ({names} ...); name one of them")
    return [_Part(path) for path in found]


def _listed_parts(folder: Path) -> list[_Part]:
    """The files that metadata.yaml lists; nothing where there is none or it cannot be read."""
    information = _bag_information(folder / _METADATA)
    if information.get("storage_identifier") == "sqlite3":
        raise RecordingError(
            f"{folder} is stored in SQLite; convert it with: voxscene import bag {folder} OUT.mcap"
        )
    names = information.get("relative_file_paths")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return []
    counts = {}
    files = information.get("files")
    for file in files if isinstance(files, list) else []:
        if (
            isinstance(file, dict)
            and isinstance(file.get("message_count"), int)
            and file["message_count"] > 0
        ):
            counts[Path(str(file.get("path"))).name] = file["message_count"]
    # Older versions of rosbag2 put the folder's own name before the file's.
    return [_Part(folder / Path(name).name, counts.get(Path(name).name, 0)) for name in names]


def _bag_information(path: Path) -> dict[str, Any]:
    from ruamel.yaml import YAML, YAMLError  # seldom needed

    if not path.is_file() or path.stat().st_size > _LARGEST_METADATA:
        return {}
    try:
        content = YAML(typ="safe", pure=True).load(path.read_text(encoding=TEXT))
    except (OSError, UnicodeDecodeError, YAMLError, ValueError, RecursionError):
        return {}  # the files themselves say what is in them
    information = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    return information if isinstance(information, dict) else {}


def _stem(path: Path) -> str:
    return _SPLIT_NUMBER.sub("", _without_suffix(path))


def _number(path: Path) -> int:
    match = _SPLIT_NUMBER.search(_without_suffix(path))
    return int(match[1]) if match else -1


def _without_suffix(path: Path) -> str:
    return (path.with_suffix("") if path.suffix in ZSTD_SUFFIXES else path).name.removesuffix(".mcap")
