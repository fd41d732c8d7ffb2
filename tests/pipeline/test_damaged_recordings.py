"""A real recording cut and flipped at random places, read as a user reads it."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from pipeline.cli import voxscene

COPIES = 200


def info(path: Path) -> tuple[int, dict[str, Any]]:
    """Exit code and document of `voxscene info`; an empty document where it failed in one clear line."""
    result = CliRunner().invoke(voxscene, ["info", str(path), "--json", "--hash"])
    assert result.exception is None or isinstance(result.exception, SystemExit)
    if result.exit_code == 1:
        assert result.stdout == ""
        assert result.stderr.startswith("voxscene: ")
        assert result.stderr.count("\n") == 1
        return 1, {}
    return result.exit_code, json.loads(result.stdout)


def cuts(data: bytes, rng: np.random.Generator) -> Iterator[tuple[str, bytes]]:
    """The beginning of a file, of random lengths."""
    for size in rng.integers(0, len(data), COPIES):
        yield f"cut at {size}", data[:size]


def flips(data: bytes, rng: np.random.Generator) -> Iterator[tuple[str, bytes]]:
    """A file with one random bit turned."""
    for place, bit in zip(rng.integers(0, len(data), COPIES), rng.integers(0, 8, COPIES), strict=True):
        damaged = bytearray(data)
        damaged[place] ^= 1 << int(bit)
        yield f"bit {bit} of byte {place}", bytes(damaged)


@pytest.mark.slow
@pytest.mark.parametrize("damage", [cuts, flips])
@pytest.mark.parametrize(
    "name",
    [
        "redkitchen_12_16UC1_zstd",
        "redkitchen_3_16UC1_nocompression",
        "redkitchen_60_compressedDepth_lz4",
    ],
)
def test_what_is_lost_is_counted_and_what_is_given_is_intact(
    name: str, damage: Any, shared_data: Path, tmp_path: Path, seed: int
) -> None:
    """Frames keep their hashes and their order; a frame less is a loss that is told."""
    original = shared_data / "mcap_depth" / f"{name}.mcap"
    code, intact = info(original)
    assert code == 0
    hashes = intact["frame_hashes"]
    path = tmp_path / "damaged.mcap"
    read = 0
    for how, data in damage(original.read_bytes(), np.random.default_rng(seed)):
        path.write_bytes(data)
        code, document = info(path)
        found = document.get("frame_hashes", [])
        remaining = iter(hashes)
        assert all(one in remaining for one in found), how  # a subsequence
        lost = bool(document) and document["lost_messages"] + document["lost_chunks"] > 0
        assert code == (3 if lost else 1 if not document else 0), how
        assert len(found) == len(hashes) or code != 0, how
        read += bool(found)
    assert read > COPIES / 4  # of three frames in two chunks, a cut in the first leaves none
