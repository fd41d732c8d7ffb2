"""Everything in a run folder that is derived from its values; made again where it is not what it was."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pipeline.atomic import write_json
from pipeline.fingerprints import PROGRAM, canonical_hash, file_hash, source_hash
from pipeline.run_folder import RunFolder

_RECORD = "stages/published.json"


def publish(run: RunFolder) -> None:
    """Write the files of `write_derived_files` (settings, summaries, paths, views), each atomically.

    All but timing.json are functions of the committed values alone, so that a resumed run ends with the
    same content as an undisturbed one; and the same bytes, but for Rerun's own. Hashes of what was written
    are kept: a file that is damaged, missing or made by another program is made again.

    Raises:
        PipelineError: a file cannot be written; those before it are whole.
    """
    made_from = {
        "records": _records_hash(run),
        "sources": source_hash("pipeline.publishing.derived_files", within=PROGRAM),
    }
    if _is_published(run.path, made_from):
        return
    from pipeline.publishing.derived_files import write_derived_files

    (run.path / _RECORD).unlink(missing_ok=True)
    written = write_derived_files(run)
    files = {path.relative_to(run.path).as_posix(): file_hash(path) for path in written}
    write_json(run.path / _RECORD, {"made_from": made_from, "files": files})


def stage_document(run: RunFolder, name: str) -> dict[str, Any]:
    """The object that a command prints with --json: the stage's summary with its timings merged in."""
    summary, timing = (json.loads((run.path / f"{file}.json").read_text()) for file in ("summary", "timing"))
    for part in name.split("/"):
        summary, timing = summary[part], timing[part]
    return {**summary, **timing}


def tells_committed_values(run: RunFolder) -> bool:
    """Whether derived files were made, by any program, from the values that are committed now.

    They were not where a command was cut off between the two.
    """
    with suppress(OSError, ValueError, TypeError, KeyError):
        published = json.loads((run.path / _RECORD).read_text())
        return published["made_from"]["records"] == _records_hash(run)
    return False


def _records_hash(run: RunFolder) -> str:
    """Of all that is known of the committed stages: their values, warnings and seconds are told."""
    return canonical_hash({name: vars(record) for name, record in run.records().items()})


def _is_published(folder: Path, made_from: Mapping[str, str]) -> bool:
    """True if every derived file is as it was written, made from the values that are committed now."""
    with suppress(OSError, ValueError, TypeError, KeyError, AttributeError):
        published = json.loads((folder / _RECORD).read_text())
        return published["made_from"] == made_from and all(
            file_hash(folder / name) == digest for name, digest in published["files"].items()
        )
    return False
