"""Files appear whole or not at all."""

import errno
import os
from pathlib import Path

import pytest

from pipeline.atomic import atomic_path, write_json, write_table, write_text
from pipeline.errors import PipelineError


def test_a_finished_file_takes_its_name(tmp_path: Path) -> None:
    """And nothing else stays behind."""
    with atomic_path(tmp_path / "value.npz") as partial:
        assert partial.suffix == ".npz"
        partial.write_bytes(b"whole")
        assert not (tmp_path / "value.npz").exists()

    assert [path.name for path in tmp_path.iterdir()] == ["value.npz"]
    assert (tmp_path / "value.npz").read_bytes() == b"whole"


def test_a_failure_leaves_the_old_file(tmp_path: Path) -> None:
    """Untouched, without a trace of the new one."""
    write_text(tmp_path / "a.txt", "old")

    def fail_halfway() -> None:
        with atomic_path(tmp_path / "a.txt") as partial:
            partial.write_text("half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_halfway()

    assert [path.read_text() for path in tmp_path.iterdir()] == ["old"]


def test_what_cannot_be_written_is_one_clear_error(tmp_path: Path) -> None:
    """With the path and the reason."""
    with pytest.raises(PipelineError, match=r"cannot write .*none.*: No such file"):
        write_text(tmp_path / "none" / "a.txt", "text")


def test_a_read_only_disk_is_told_with_the_files_own_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There even what was never made cannot be removed."""

    def refuse(path: Path, *_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    monkeypatch.setattr(Path, "write_bytes", refuse)
    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(PipelineError, match=f"cannot write {tmp_path}/page.html: Read-only file system"):
        write_text(tmp_path / "page.html", "page")


def test_names_of_files_in_a_text_need_not_be_utf8(tmp_path: Path) -> None:
    """As of disks from elsewhere: the text itself has to be."""
    write_text(tmp_path / "a.txt", os.fsdecode(b"name = k\xfcche.mcap\n"))
    assert (tmp_path / "a.txt").read_text(encoding="utf-8") == "name = k?che.mcap\n"


def test_json_is_readable_and_finite(tmp_path: Path) -> None:
    """NaN is no JSON."""
    write_json(tmp_path / "a.json", {"b": [1, 2.5]})
    assert (tmp_path / "a.json").read_text() == '{\n  "b": [\n    1,\n    2.5\n  ]\n}\n'

    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", {"b": float("nan")})


def test_tables_hold_their_columns_alone(tmp_path: Path) -> None:
    """A heading, then what the columns name; None is empty, and commas are quoted."""
    write_table(tmp_path / "t.csv", ("a", "b"), [{"a": 1, "b": None, "c": 2}, {"a": "x, y", "b": 0.5}])
    assert (tmp_path / "t.csv").read_text() == 'a,b\n1,\n"x, y",0.5\n'
