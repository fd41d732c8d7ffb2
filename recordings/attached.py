"""Files that a recording carries beside its messages, as files again."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from recordings.errors import RecordingError
from recordings.mcap_files.attachments import attachment_data
from recordings.mcap_files.framing import MalformedRecord
from recordings.mcap_files.mcap_file import McapFile
from recordings.mcap_files.sources import open_source


def save_attachments(path: Path, folder: Path) -> list[Path]:
    """Write the attachments of an MCAP file below a folder, under their own names.

    Returns:
        The files.

    Raises:
        RecordingError: the file or an attachment cannot be read, or a name leads out of the folder.
    """
    saved = []
    attachments = McapFile(path).index.attachments
    with open_source(path) as source:
        for attachment in attachments:
            name = PurePosixPath(attachment.name)
            if name.is_absolute() or ".." in name.parts or not name.parts:
                raise RecordingError(f"{path} holds an attachment named {attachment.name!r}: no file's name")
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                target.write_bytes(attachment_data(source, attachment))
            except MalformedRecord as error:
                raise RecordingError(f"{path}: {error}") from error
            saved.append(target)
    return saved
