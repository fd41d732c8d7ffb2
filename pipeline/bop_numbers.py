"""Numbers of objects, scenes and images in BOP's files: from the models, from the recording, or by place.

https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pipeline.errors import ConfigError
from recordings.settings import TEXT

BOP_NAME = re.compile(r"obj_(\d+)$")
"""Names of BOP's own models."""


def numbered(names: Iterable[str], *known: Mapping[str, int]) -> dict[str, int]:
    """An id for every name, no two alike.

    Args:
        names: of the objects.
        known: ids by name, the more trusted first. Names without one are given the lowest numbers that are
            left, in the order of the alphabet.
    """
    ids: dict[str, int] = {}
    wanted = sorted(names)
    for source in known:
        for name in wanted:
            if name in source and name not in ids and source[name] not in ids.values():
                ids[name] = source[name]
    free = (number for number in range(1, 2 * len(wanted) + 1) if number not in ids.values())
    for name in wanted:
        if name not in ids:
            ids[name] = next(free)
    return ids


def ids_of_names(names: Iterable[str]) -> dict[str, int]:
    """Ids of those names that BOP gives to models, obj_NNNNNN."""
    return {name: int(found[1]) for name in names if (found := BOP_NAME.match(name))}


def ids_of_models(folder: Path) -> dict[str, int]:
    """Ids by name from models_info.json: of BOP, whose names hold them, or a list of named entries."""
    try:
        content = json.loads((folder / "models_info.json").read_text(encoding=TEXT))
    except (OSError, ValueError):
        return {}
    if not isinstance(content, list):
        return {}
    found = {}
    for entry in content:
        if isinstance(entry, dict) and isinstance(entry.get("name"), str):
            number = entry.get("obj_id", entry.get("cls_index"))
            if isinstance(number, int):
                found[entry["name"]] = number
    return found


def read_ids(path: Path | None) -> dict[str, int]:
    """Ids by name from a JSON file of the user: {"mug": 14, "can": 1}; none without a file.

    Raises:
        ConfigError: the file cannot be read, or says something else.
    """
    if path is None:
        return {}
    try:
        content: Any = json.loads(path.read_text(encoding=TEXT))
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        raise ConfigError(f"{path} is not JSON: {error}") from error
    if not isinstance(content, dict) or not all(_is_id(number) for number in content.values()):
        raise ConfigError(f'{path}: write ids by name, such as {{"mug": 14, "can": 1}}')
    if len(set(content.values())) < len(content):
        raise ConfigError(f"{path}: two names have the same id")
    return content


def _is_id(number: Any) -> bool:
    return isinstance(number, int) and not isinstance(number, bool) and number > 0
