"""Files of an export: each whole or not at all, and none over another that says something else."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from pipeline.atomic import atomic_path, write_json
from pipeline.errors import PipelineError

MANIFEST = "manifest.json"
FORMAT_VERSION = 2


def write_files(
    out: Path,
    contents: Mapping[str, bytes],
    manifest: Mapping[str, Mapping[str, Any]],
    *,
    grows: Collection[str] = (),
    force: bool = False,
) -> list[Path]:
    """Write files into a folder, and what they are into its manifest.json when all of them stand.

    Args:
        out: the folder, made if it is not there.
        contents: by path inside the folder.
        manifest: by what was exported, what its entry says; entries of earlier exports stay.
        grows: of `contents`, files that hold what the folder had and more.
        force: replace files that say something else.

    Returns:
        The files, the manifest last.

    Raises:
        PipelineError: a file is there and differs, or the folder cannot be written; nothing is written then.
    """
    entries = _entries(out / MANIFEST)
    for name, content in contents.items():
        if name not in grows and not force and _differs(out / name, content):
            raise PipelineError(
                f"{out / name} is there and differs: name another folder with -o, or replace it with --force"
            )
    for name, content in contents.items():
        path = out / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise PipelineError(f"cannot make the folder {path.parent}: {error.strerror}") from error
        with atomic_path(path) as partial:
            partial.write_bytes(content)
    for name, entry in manifest.items():
        entries[name] = _joined(entries.get(name, {}), entry)
    write_json(out / MANIFEST, {"format_version": FORMAT_VERSION, "exports": entries})
    return [*(out / name for name in contents), out / MANIFEST]


def _joined(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """An entry with the files of an earlier export that this one did not write again."""
    written = {file["file"] for file in new["files"]}
    kept = [file for file in old.get("files", []) if file["file"] not in written]
    return {**old, **new, "files": [*kept, *new["files"]]}


def _differs(path: Path, content: bytes) -> bool:
    return path.exists() and (not path.is_file() or path.read_bytes() != content)


def _entries(path: Path) -> dict[str, Any]:
    """What earlier exports into the folder wrote."""
    if not path.exists():
        return {}
    try:
        manifest = json.loads(path.read_text())
        if manifest["format_version"] == FORMAT_VERSION:
            return dict(manifest["exports"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PipelineError(f"{path} is no manifest of voxscene ({error!r}); name another folder") from error
    raise PipelineError(f"{path} is of another version of voxscene; name another folder with -o")
