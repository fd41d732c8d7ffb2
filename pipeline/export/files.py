"""Files of an export: each whole or not at all, and none over another that says something else."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Literal, get_args

from pipeline.atomic import atomic_path, write_json
from pipeline.errors import PipelineError

MANIFEST = "manifest.json"
FORMAT_VERSION = 3

Kind = Literal["shapes", "runs"]
"""What entries of a manifest are of; a run and a shape may have one name."""


def write_files(
    out: Path,
    contents: Mapping[str, bytes],
    kind: Kind,
    manifest: Mapping[str, Mapping[str, Any]],
    *,
    grows: Collection[str] = (),
    force: bool = False,
) -> list[Path]:
    """Write files into a folder, and what they are into its manifest.json when all of them stand.

    Args:
        out: the folder, made if it is not there.
        contents: by path inside the folder.
        kind: of what was exported.
        manifest: by what was exported, what its entry says; entries of earlier exports stay, their files too
            where the entry says the same of them.
        grows: of `contents`, files that hold what the folder had and more.
        force: replace files that say something else.

    Returns:
        The files, the manifest last.

    Raises:
        PipelineError: a file is there and differs, or an entry that would be joined with this one's says
            something else, or the folder cannot be written; nothing is written then.
    """
    entries = manifest_entries(out)
    for name, entry in manifest.items():
        entries[kind][name] = _joined(out, entries[kind].get(name), entry, force=force)
    paths = write_contents(out, contents, grows=grows, force=force)
    write_json(out / MANIFEST, {"format_version": FORMAT_VERSION, **entries})
    return [*paths, out / MANIFEST]


def write_contents(
    out: Path, contents: Mapping[str, bytes], *, grows: Collection[str] = (), force: bool = False
) -> list[Path]:
    """Write files into a folder of which its manifest says nothing; arguments as of `write_files`.

    Returns:
        The files.

    Raises:
        PipelineError: a file is there and differs, or the folder cannot be written; nothing is written then.
    """
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
    return [out / name for name in contents]


def _joined(
    out: Path, old: Mapping[str, Any] | None, new: Mapping[str, Any], *, force: bool
) -> dict[str, Any]:
    """An entry with the files of an earlier export that this one does not write again.

    What an entry says holds for all of its files: where this export says something else, the earlier ones
    are left out if `force` is given.

    Raises:
        PipelineError: it says something else, and `force` is not given.
    """
    written = {file["file"] for file in new["files"]}
    kept = [file for file in (old or {}).get("files", []) if file["file"] not in written]
    if not old or not kept:
        return dict(new)
    other = [key for key in {**old, **new} if key != "files" and old.get(key) != new.get(key)]
    if other and not force:
        raise PipelineError(
            f"{out / kept[0]['file']} is there with another {other[0]}, see {MANIFEST}: name another folder"
            " with -o, or leave it out of the manifest with --force"
        )
    return {**new, "files": [*([] if other else kept), *new["files"]]}


def _differs(path: Path, content: bytes) -> bool:
    return path.exists() and (not path.is_file() or path.read_bytes() != content)


def manifest_entries(out: Path) -> dict[Kind, dict[str, Any]]:
    """What earlier exports into the folder wrote, by kind and name.

    Raises:
        PipelineError: its manifest.json is none of this program.
    """
    path, kinds = out / MANIFEST, get_args(Kind)
    if not path.exists():
        return {kind: {} for kind in kinds}
    try:
        manifest = json.loads(path.read_text())
        if manifest["format_version"] == FORMAT_VERSION:
            return {kind: dict(manifest[kind]) for kind in kinds}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PipelineError(f"{path} is no manifest of voxscene ({error!r}); name another folder") from error
    raise PipelineError(f"{path} is of another version of voxscene; name another folder with -o")
