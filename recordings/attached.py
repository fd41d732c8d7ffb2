"""Files that a recording carries beside its messages, as files again."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from recordings.errors import RecordingError
from recordings.mcap_files.attachments import Attachment, attachment_data
from recordings.mcap_files.framing import MalformedRecord
from recordings.mcap_files.mcap_file import McapFile
from recordings.mcap_files.sources import open_source


def save_attachments(path: Path, folder: Path) -> list[Path]:
    """Write the attachments of an MCAP file below a folder, under their own names.

    Returns:
        The files.

    Raises:
        RecordingError: the file or an attachment cannot be read, a file cannot be written, or a name is
            another's or leads out of the folder.
    """
    saved: list[Path] = []
    attachments = McapFile(path).index.attachments
    with open_source(path) as source:
        for attachment in attachments:
            target = folder / _file_name(path, attachment)
            if target in saved:
                raise RecordingError(f"{path} holds two attachments named {attachment.name!r}")
            try:
                content = attachment_data(source, attachment)
            except MalformedRecord as error:
                raise RecordingError(f"{path}: {error}") from error
            _write(target, content)
            saved.append(target)
    return saved


def _file_name(path: Path, attachment: Attachment) -> PurePosixPath:
    """The attachment's name, which an MCAP file may give as any text."""
    name = PurePosixPath(attachment.name)
    if name.is_absolute() or ".." in name.parts or not name.parts or "\0" in attachment.name:
        raise RecordingError(f"{path} holds an attachment named {attachment.name!r}: no file's name")
    return name


def _write(target: Path, content: bytes) -> None:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)
    except OSError as error:
        raise RecordingError(f"cannot write {target}: {error.strerror}") from error
