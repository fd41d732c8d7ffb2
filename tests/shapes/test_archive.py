"""Arrays in a file: what is damaged is refused in one line, whatever the damage."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from shapes.archive import Archived, load_arrays, save_arrays

ARRAYS = {"format_version": np.array(1), "numbers": np.arange(6.0).reshape(2, 3)}


@dataclass(frozen=True, eq=False)
class Numbers(Archived):
    """Some numbers."""

    FORMAT_VERSION = 1
    TITLE = "row of numbers"
    numbers: NDArray[np.float64]


@pytest.mark.parametrize("compressed", [True, False])
def test_every_flipped_bit_of_the_head_is_harmless_or_told(tmp_path: Path, compressed: bool) -> None:
    """NumPy parses an array's header before the zip's checksum is due, and raises seven kinds of errors."""
    path = tmp_path / "numbers.npz"
    save_arrays(path, ARRAYS, compressed=compressed)
    content = bytearray(path.read_bytes())
    refusals = list[str]()
    for bit in range(8 * 160):
        damaged = content.copy()
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            found = load_arrays(path)
        except ValueError as error:
            refusals.append(str(error))
        else:
            assert all(np.array_equal(found[name], ARRAYS[name]) for name in found.keys() & ARRAYS.keys())

    assert len(refusals) > 600
    assert all(text.startswith(f"{path} is not a readable npz file") for text in refusals)
    assert not any("\n" in text for text in refusals)


def test_a_version_that_is_no_number_is_refused_by_the_name_of_the_file(tmp_path: Path) -> None:
    """A row of versions is none."""
    path = tmp_path / "numbers.npz"
    save_arrays(path, {**ARRAYS, "format_version": np.arange(2)})

    with pytest.raises(ValueError, match=r"numbers\.npz is not a row of numbers of format 1"):
        Numbers.load(path)


def test_a_file_has_the_rights_that_files_have_here_and_nothing_is_left_beside_it(tmp_path: Path) -> None:
    """As `open` would make it under the mask of the process, which stays what it was."""
    path, mask = tmp_path / "numbers.npz", os.umask(0o027)
    try:
        Numbers(numbers=np.arange(3.0)).save(path)
        assert os.umask(0o027) == 0o027
    finally:
        os.umask(mask)

    assert path.stat().st_mode & 0o777 == 0o640
    assert list(tmp_path.iterdir()) == [path]
