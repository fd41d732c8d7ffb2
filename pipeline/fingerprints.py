"""Hashes that tell whether things were made from the same: files, settings, and the program itself."""

from __future__ import annotations

import hashlib
import json
import re
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
"""The folder that holds the program's packages."""
METHOD = ("recordings", "shapes", "slam", "scene")
"""The packages that compute; what `pipeline` computes itself is named by those who use it."""
PROGRAM = (*METHOD, "pipeline")
"""All packages, for what must follow every import: it is cheap, or what `pipeline` computes itself."""
COMPUTES = (*METHOD, *(f"pipeline.{part}" for part in ("benchmarks", "evaluation", "peers", "synthesis")))
"""Where the sources are that decide a row of a benchmark."""

_IMPORT = re.compile(r"^\s*(?:from\s+([\w.]+)\s+import\s+(\([^)]*\)|[^\n]*)|import\s+([\w.]+))", re.MULTILINE)


def file_hash(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def recording_hash(path: Path) -> str:
    """SHA-256 of a recording's file, or of the names and contents of the files that a folder is read from.

    What else stands in the folder, such as a run that was made from it, is no part of the recording.

    Raises:
        RecordingError: the folder holds no recording.
    """
    if not path.is_dir():
        return file_hash(path)
    from recordings.mcap_files.bag import files_of  # takes 0.3 s with NumPy, and folders are seldom

    digest = hashlib.sha256()
    for member in sorted(files_of(path)):
        digest.update(f"{member.name}\0{file_hash(member)}\0".encode())
    return digest.hexdigest()


def canonical_hash(content: Any) -> str:
    """SHA-256 of plain values; the order of keys does not count."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@cache
def source_hash(*modules: str, within: tuple[str, ...] = METHOD) -> str:
    """SHA-256 over the sources of modules and of all that they reach by imports.

    Args:
        modules: dotted names, hashed wherever they live.
        within: packages and modules into which imports are followed.
    """
    waiting, reached = list(modules), dict[str, bytes]()
    while waiting:
        module = waiting.pop()
        path = _source(module)
        if module in reached or path is None:
            continue
        reached[module] = path.read_bytes()
        waiting += [name for name in _imports(reached[module].decode()) if _is_within(name, within)]
    digest = hashlib.sha256()
    for module in sorted(reached):
        digest.update(f"{module}\0{hashlib.sha256(reached[module]).hexdigest()}\0".encode())
    return digest.hexdigest()


@cache
def program_hash() -> str:
    """SHA-256 over all sources of the program: benchmarks hand kernels functions of their own."""
    packages = *METHOD, "pipeline"
    members = [path for package in packages for path in sorted((ROOT / package).rglob("*.py"))]
    return canonical_hash([[path.relative_to(ROOT).as_posix(), file_hash(path)] for path in members])


def _imports(text: str) -> list[str]:
    """Modules that a source may import: `from a import b` may mean a.b."""
    found = []
    for package, names, module in _IMPORT.findall(text):
        found.append(package or module)
        found += [f"{package}.{name}" for name in re.findall(r"\w+", names)] if package else []
    return found


def _is_within(module: str, packages: tuple[str, ...]) -> bool:
    return any(module == package or module.startswith(f"{package}.") for package in packages)


def _source(module: str) -> Path | None:
    path = ROOT.joinpath(*module.split("."))
    return next((one for one in (path.with_suffix(".py"), path / "__init__.py") if one.is_file()), None)
