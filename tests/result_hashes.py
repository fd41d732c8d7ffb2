"""Prints one SHA-256 for each result file of a fixed set of runs: equal lines mean equal bytes.

    python tests/result_hashes.py DATA SCRATCH [CASE ...]

DATA is a folder with `sevenscenes_redkitchen` and `ycbv`, SCRATCH where recordings and runs are written.
Used before and after a change that is to move no number: same seed, same machine, same cores.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RESULTS = (
    "slam.npz",
    "room.npz",
    "objects.npz",
    "parse.npz",
    "shapes/*.npz",
    "summary.json",
    "trajectory.*",
    "poses.csv",
    "run.mcap",
    "config.toml",
)
"""Below a run folder; what holds clocks or is drawn from these is left out."""


def main(data: Path, scratch: Path, names: list[str]) -> None:
    """Run the cases `names`, all by default, and print the hashes of their results."""
    scratch.mkdir(parents=True, exist_ok=True)
    for name in names or CASES:
        run = scratch / name
        CASES[name](data, run)
        for path in sorted({path for pattern in RESULTS for path in run.rglob(pattern)}):
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            print(f"{digest}  {name}/{path.relative_to(run)}", flush=True)


def _voxscene(*arguments: str | Path, output: Path) -> None:
    """Run one command whose outputs go below `output`; text goes to a file beside it."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with output.with_suffix(".txt").open("a") as text:
        subprocess.run(
            [sys.executable, "-m", "pipeline", *map(str, arguments), "-q"],
            check=True,
            env=environment,
            stdout=text,
            stderr=text,
        )


def _demo(data: Path, run: Path) -> None:
    del data
    _voxscene("demo", "--out", run, output=run)


def _kitchen(data: Path, run: Path) -> None:
    recording = run.with_suffix(".mcap")
    _voxscene("import", "7scenes", data / "sevenscenes_redkitchen", recording, output=run)
    _voxscene("slam", recording, "--end", "3.34", "-o", run, output=run)


def _views(data: Path, run: Path) -> None:
    """Five views round an object, far apart."""
    del data
    recording = run.with_suffix(".mcap")
    film = ("--object", "mug", "--path", "rings", "--frames", "5", "--seed", "7")
    _voxscene("synth", "objects", recording, *film, output=run)
    _voxscene("slam", recording, "-o", run, output=run)


def _circle(data: Path, run: Path) -> None:
    """A whole circle of five in a bare room."""
    del data
    recording = run.with_suffix(".mcap")
    film = ("--object", "mug", "--room", "bare", "--path", "orbit", "--step", "72", "--frames", "5")
    _voxscene("synth", "objects", recording, *film, "--seed", "7", output=run)
    _voxscene("slam", recording, "-o", run, output=run)


def _tabletop(*options: str) -> Callable[[Path, Path], None]:
    """A real table, parsed with `options`."""

    def case(data: Path, run: Path) -> None:
        recording = run.with_suffix(".mcap")
        _voxscene("import", "bop", data / "ycbv/scenes/0001", recording, output=run)
        meshes = data / "ycbv/models"
        _voxscene("parse", recording, "--shapes", meshes, *options, "-o", run, output=run)

    return case


def _learned(*options: str) -> Callable[[Path, Path], None]:
    """A small synthetic table, parsed with two learned shapes and `options`."""

    def case(data: Path, run: Path) -> None:
        del data
        shapes = run.with_name(f"{run.name}-shapes")
        for name in ("mug", "box"):
            film = run.with_name(f"{run.name}-{name}.mcap")
            rings = ("--object", name, "--path", "rings", "--frames", "12", "--seed", "3")
            _voxscene("synth", "objects", film, *rings, output=run)
            _voxscene("learn", film, "--name", name, "-o", shapes / name, output=run)
        table = run.with_name(f"{run.name}-table.mcap")
        _voxscene("synth", "scenes", table, "--objects", "2", "--seed", "3", output=run)
        library = shapes / "library"
        library.mkdir(exist_ok=True)
        for name in ("mug", "box"):
            (library / f"{name}.npz").write_bytes((shapes / name / "shapes" / f"{name}.npz").read_bytes())
        _voxscene("parse", table, "--shapes", library, *options, "-o", run, output=run)

    return case


_FOUR = "002_master_chef_can,003_cracker_box,004_sugar_box,006_mustard_bottle"
CASES: dict[str, Callable[[Path, Path], None]] = {
    "demo": _demo,
    "kitchen": _kitchen,
    "views": _views,
    "circle": _circle,
    "all-shapes": _tabletop("--frames", "0"),
    "three-frames": _tabletop("--frames", "0:3", "--objects", _FOUR),
    "cloud": _tabletop("--frames", "0", "--objects", _FOUR, "--likelihood", "cloud"),
    "fixed-graph": _tabletop("--frames", "0", "--objects", _FOUR, "--graph", "fixed"),
    "shape-samples": _learned("--shape-samples", "4"),
}

if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve(), sys.argv[3:])
