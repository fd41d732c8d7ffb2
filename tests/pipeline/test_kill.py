"""`kill -9` at random moments of `voxscene run`, then again: the same results as without."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = """
[slam]
particles = 16
[parse]
rounds = 0
sweeps = 12
chains = 2
[[recording]]
path = "can.mcap"
stage = "learn"
[[recording]]
path = "table.mcap"
stage = "parse"
"""
RESULTS = ("summary.json", "trajectory.tum", "run.mcap", "config.toml", "poses.csv", "shapes/*.npz")
KILLS = 20


def voxscene(*arguments: object) -> subprocess.Popen[bytes]:
    """The program in a process of its own."""
    environment = dict(os.environ, JAX_COMPILATION_CACHE_DIR=str(ROOT / ".cache" / "jax"))
    words = [str(argument) for argument in arguments]
    return subprocess.Popen(
        [sys.executable, "-m", "pipeline", *words], cwd=ROOT, env=environment, stderr=subprocess.DEVNULL
    )


def results(run: Path) -> dict[str, bytes]:
    """Everything that must not depend on how often the program was interrupted."""
    return {
        path.relative_to(run).as_posix(): path.read_bytes()
        for pattern in RESULTS
        for path in run.rglob(pattern)
    }


@pytest.mark.slow
def test_a_killed_run_ends_like_an_undisturbed_one(tmp_path: Path, seed: int) -> None:
    """Five runs, each killed four times on what was left, then let through."""
    small = ("--size", "160x120", "--radius", 0.6, "--quiet")
    assert voxscene("synth", "objects", tmp_path / "can.mcap", "--frames", 12, *small).wait() == 0
    table = ("--objects", 1, "--only", "can", "--frames", 3)
    assert voxscene("synth", "scenes", tmp_path / "table.mcap", *table, *small).wait() == 0
    (tmp_path / "project.toml").write_text(PROJECT)
    command = ("run", tmp_path / "project.toml", "--quiet", "-o")
    assert voxscene(*command, tmp_path / "warm").wait() == 0
    begun = time.monotonic()
    assert voxscene(*command, tmp_path / "whole").wait() == 0
    duration_s = time.monotonic() - begun
    expected = results(tmp_path / "whole")
    assert {"recordings/can/shapes/can.npz", "shapes/can.npz", "recordings/table/poses.csv"} <= set(expected)

    moments = random.Random(seed)
    rounds = 0
    for kill in range(KILLS):
        folder = tmp_path / f"killed {rounds}"
        child = voxscene(*command, folder)
        try:
            child.wait(moments.uniform(0.05, 1.0) * duration_s)
        except subprocess.TimeoutExpired:
            child.send_signal(signal.SIGKILL)
            child.wait()
        if kill % 4 == 3:
            assert voxscene(*command, folder).wait() == 0
            assert results(folder) == expected
            rounds += 1
