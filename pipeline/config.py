"""Settings from a TOML file and from `-s section.key=value`, resolved into the stages' own dataclasses.

Later wins: defaults, the file, `-s`, the command's options. Sections are named after their stage.
"""

from __future__ import annotations

import copy
import difflib
import math
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from pipeline.errors import ConfigError
from recordings.settings import TEXT

T = TypeVar("T")

SECTIONS = ("run", "recording", "slam", "learn", "parse", "synth")
"""Every section that a settings file may have."""


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """What holds for every stage.

    Attributes:
        seed: root of all randomness.
    """

    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"seed must lie in [0, 2^32), got {self.seed}")


class Settings:
    """What the user set, by section, as plain values."""

    def __init__(self, values: Mapping[str, Mapping[str, Any]]) -> None:
        self._values = values

    @classmethod
    def read(
        cls, path: Path | None, overrides: Sequence[str], sections: Sequence[str] = SECTIONS
    ) -> Settings:
        """Settings of a TOML file, or none, and of overrides such as "slam.particles=64".

        Args:
            path: the file.
            overrides: from the command line; values are TOML, bare words are strings.
            sections: those that the command reads; others may stand in the file, not in an override.

        Raises:
            ConfigError: the file cannot be read, or an override has no such form or section.
        """
        values = checked_sections(read_toml(path), path) if path else {}
        for override in overrides:
            key, separator, text = override.partition("=")
            names = key.strip().split(".")
            if not separator or len(names) < 2 or not all(names):
                raise ConfigError(f"-s {override}: write section.key=value, such as {sections[0]}.key=1")
            if names[0] not in sections:
                raise ConfigError(
                    f"-s {override}: no section {names[0]!r} here; {_choices(names[0], sections)}"
                )
            _put(values, names, _toml_value(text.strip()), f"-s {override}")
        return cls(values)

    def over(self, values: Mapping[str, Mapping[str, Any]]) -> Settings:
        """These settings, and beneath them others that hold where these say nothing."""
        return Settings(_merged(values, self._values))

    def section(self, name: str, kind: type[T], options: Mapping[str, Any] | None = None) -> T:
        """The dataclass `kind` filled from a section.

        Args:
            name: the section.
            kind: a dataclass, whose fields may be dataclasses.
            options: what the command's own options say, by key or dotted key; None says nothing.

        Raises:
            ConfigError: an unknown key, or a value that cannot be used; the message names it.
        """
        values = copy.deepcopy(dict(self._values.get(name, {})))
        for key, value in (options or {}).items():
            if value is not None:
                _put(values, key.split("."), value, f"{name}.{key}")
        return build(kind, values, name) if values else kind()


def build(kind: type[T], values: Mapping[str, Any], where: str) -> T:
    """The dataclass `kind` made from plain values; `where` names them in messages.

    Raises:
        ConfigError: an unknown key, or a value that cannot be used.
    """
    from pydantic import TypeAdapter, ValidationError

    for path, known in _unknown_keys(kind, values, where):
        key = path.rpartition(".")[2]
        raise ConfigError(f"there is no setting {path}; {_choices(key, known)}")
    try:
        return TypeAdapter(kind).validate_python(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join([where, *(str(part) for part in first["loc"])])
        message = first["msg"].removeprefix("Value error, ")
        value = first["input"]
        given = "" if isinstance(value, Mapping) else f", got {value!r}"
        raise ConfigError(f"{place}: {message[0].lower()}{message[1:]}{given}") from error


def plain_values(config: Any, *, paths: bool = True) -> Any:
    """A configuration as tables, lists and scalars, as TOML and JSON hold them; None is left out.

    Numbers that are not finite, which JSON does not hold, become words.

    Args:
        config: dataclasses, mappings, sequences and scalars.
        paths: whether paths are among them, or left out as None is.
    """
    if is_dataclass(config):
        config = {field.name: getattr(config, field.name) for field in fields(config)}
    if isinstance(config, Mapping):
        left_out = type(None) if paths else (type(None), Path)
        return {
            str(name): plain_values(value, paths=paths)
            for name, value in config.items()
            if not isinstance(value, left_out)
        }
    if isinstance(config, tuple | list):
        return [plain_values(value, paths=paths) for value in config]
    if isinstance(config, Path) or (isinstance(config, float) and not math.isfinite(config)):
        return str(config)
    return config


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        ConfigError: it cannot be read.
    """
    try:
        return tomllib.loads(path.read_text(encoding=TEXT))
    except OSError as error:
        raise ConfigError(f"cannot read settings {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path} is not TOML: {error}") from error


def checked_sections(values: dict[str, Any], path: Path) -> dict[str, Any]:
    """The same values if they are sections of settings.

    Raises:
        ConfigError: a section is not known or is no table; `path` says where.
    """
    for name, section in values.items():
        if name not in SECTIONS:
            raise ConfigError(f"{path}: no section {name!r}; {_choices(name, SECTIONS)}")
        if not isinstance(section, dict):
            raise ConfigError(f"{path}: {name} must be a table, [{name}]")
    return values


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Tables of both, merged; single values are taken from above."""
    both = {
        name: _merged(below[name], above[name])
        for name in below.keys() & above.keys()
        if isinstance(below[name], Mapping) and isinstance(above[name], Mapping)
    }
    return {**below, **above, **both}


def _toml_value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (tomllib.TOMLDecodeError, RecursionError):
        return text


def _put(values: dict[str, Any], names: Sequence[str], value: Any, where: str) -> None:
    table = values
    for name in names[:-1]:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise ConfigError(f"{where}: {name} is a value, it holds no settings")
    table[names[-1]] = value


def check_names(values: Mapping[str, Any], known: Sequence[str], where: str) -> None:
    """Stop at a name that is not known.

    Raises:
        ConfigError: and what it may have been meant for.
    """
    for name in values:
        if name not in known:
            raise ConfigError(f"there is no setting {where}.{name}; {_choices(name, known)}")


def _unknown_keys(kind: Any, values: Any, where: str) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Paths of keys that no field has, with the names that would do."""
    if not is_dataclass(kind) or not isinstance(values, Mapping):
        return
    hints = get_type_hints(kind)
    known = tuple(field.name for field in fields(kind) if field.init)
    for key, value in values.items():
        if key not in known:
            yield f"{where}.{key}", known
        else:
            yield from _unknown_keys(hints[key], value, f"{where}.{key}")


def _choices(given: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(given, known, 1)
    return f"did you mean {close[0]!r}?" if close else "there are " + ", ".join(sorted(known))
