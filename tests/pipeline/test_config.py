"""Settings become the stages' dataclasses, or one clear line."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from pipeline.bop_numbers import read_ids
from pipeline.config import Settings, build, plain_values
from pipeline.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class Inner:
    """A nested table."""

    width_m: float = 1.0
    kind: Literal["a", "b"] = "a"

    def __post_init__(self) -> None:
        if self.width_m <= 0:
            raise ValueError("width_m must be positive")


@dataclass(frozen=True, kw_only=True)
class Outer:
    """A stage's configuration."""

    count: int = 3
    limits: tuple[float, ...] = (1.0, 2.0)
    end_s: float = math.inf
    name: str | None = None
    on: bool = False
    inner: Inner = field(default_factory=Inner)


def settings(tmp_path: Path, text: str = "", *overrides: str) -> Settings:
    """Settings of a file with this text and of overrides."""
    path = tmp_path / "settings.toml"
    path.write_text(text)
    return Settings.read(path, overrides, ("slam", "recording"))


def test_later_wins(tmp_path: Path) -> None:
    """Defaults, then the file, then -s, then options of the command that say something."""
    read = settings(
        tmp_path, "[slam]\ncount = 4\non = true\n[slam.inner]\nwidth_m = 2\n", "slam.inner.width_m=3"
    )

    assert read.section("slam", Outer) == Outer(count=4, on=True, inner=Inner(width_m=3.0))
    options = {"inner.kind": "b", "count": 5, "name": None}
    expected = Outer(count=5, on=True, inner=Inner(width_m=3.0, kind="b"))
    assert read.section("slam", Outer, options) == expected
    assert read.section("recording", Outer) == Outer()


def test_overrides_are_toml_or_bare_words(tmp_path: Path) -> None:
    """Numbers, arrays, booleans, strings."""
    read = settings(tmp_path, "", "slam.limits=[3, 4.5]", "slam.name=mug", "slam.on=true", "slam.count=7")

    assert read.section("slam", Outer) == Outer(limits=(3.0, 4.5), name="mug", on=True, count=7)


@pytest.mark.parametrize(
    ("text", "overrides", "message"),
    [
        ("[slam]\ncoutn = 1", (), "no setting slam.coutn; did you mean 'count'"),
        ("[slam.inner]\nx = 1", (), "no setting slam.inner.x; there are kind, width_m"),
        ("[slam]\ncount = 'many'", (), "slam.count: .*integer.*, got 'many'"),
        ("[bench]\nscenes = 1", (), "no section 'bench'"),
        ("[slam.inner]\nwidth_m = -1", (), "slam.inner: width_m must be positive"),
        ("[slam.inner]\nkind = 'c'", (), "slam.inner.kind: .*'a' or 'b', got 'c'"),
        ("[slam]\ninner = 3", (), "slam.inner"),
        ("[slum]\n", (), "no section 'slum'; did you mean 'slam'"),
        ("slam = 3", (), "slam must be a table"),
        ("[slam", (), "is not TOML"),
        ("", ("slam.count",), "write section.key=value"),
        ("", ("count=1",), "write section.key=value"),
        ("", ("learn.x=1",), "no section 'learn' here"),
        ("", ("slam.count=1", "slam.count.x=1"), "count is a value"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, text: str, overrides: tuple[str, ...], message: str) -> None:
    """Where the mistake is, and what would do."""
    with pytest.raises(ConfigError, match=message):
        settings(tmp_path, text, *overrides).section("slam", Outer)


def test_files_of_windows_are_read(tmp_path: Path) -> None:
    """Editors there end lines with two characters, and begin files with a mark."""
    (tmp_path / "s.toml").write_bytes(b"\xef\xbb\xbf[slam]\r\ncount = 7\r\n")
    assert Settings.read(tmp_path / "s.toml", ()).section("slam", Outer).count == 7
    (tmp_path / "ids.json").write_bytes(b'\xef\xbb\xbf{"mug": 3}\r\n')
    assert read_ids(tmp_path / "ids.json") == {"mug": 3}


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    """With its path."""
    with pytest.raises(ConfigError, match=r"cannot read settings .*none\.toml"):
        Settings.read(tmp_path / "none.toml", ())


def test_plain_values_build_the_same_configuration() -> None:
    """Tables, lists and scalars; what is None is left out."""
    config = Outer(count=9, inner=Inner(kind="b"))
    plain = plain_values(config)

    assert plain == {
        "count": 9,
        "limits": [1.0, 2.0],
        "end_s": "inf",
        "on": False,
        "inner": {"width_m": 1.0, "kind": "b"},
    }
    assert build(Outer, plain, "slam") == config
