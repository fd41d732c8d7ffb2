"""JAX as the program sets it up, and kernels on disk: what is damaged is compiled anew, told, and mended."""

import logging
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from pipeline.benchmarks.pose_images import ImageKey
from pipeline.benchmarks.poses import judge_image
from pipeline.errors import PipelineError
from pipeline.kernel_cache import MOST_VERSIONS, SUFFIX, KernelCache, trace_cache
from pipeline.logs import show_on_stderr
from pipeline.task_engine import local_processes

PROGRAM = """
from pipeline.jax_setup import set_up_jax
from pipeline.logs import show_on_stderr
set_up_jax()
show_on_stderr(0)
import jax
print(float(jax.jit(lambda x: (x * x).sum())(jax.numpy.arange(64.0))))
"""


def test_matrices_are_multiplied_in_full_precision() -> None:
    """As GPUs do not by default: a point 2 m away would move by a millimetre."""
    points = jax.numpy.ones((3, 3))

    assert "HIGHEST" in jax.jit(jax.numpy.matmul).lower(points, points).as_text()


@pytest.mark.parametrize("module", ["pipeline.cli", "pipeline.executors"])
def test_commands_and_workers_do_so_without_setting_jax_up(module: str) -> None:
    """Of each the first import, before JAX."""
    program = f"import {module}, jax; print(jax.config.jax_default_matmul_precision)"
    unset = {name: value for name, value in os.environ.items() if name != "JAX_DEFAULT_MATMUL_PRECISION"}
    told = subprocess.run(
        [sys.executable, "-c", program], env=unset, capture_output=True, text=True, check=True
    )

    assert told.stdout.strip() == "highest"


def damaged(content: bytes, how: str, rng: np.random.Generator) -> bytes:
    """An entry cut, emptied, of other bytes, or with one bit turned."""
    if how == "bit":
        turned = bytearray(content)
        turned[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
        return bytes(turned)
    return {"cut": content[: len(content) // 2], "empty": b"", "other": rng.bytes(len(content))}[how]


@pytest.mark.parametrize("how", ["cut", "empty", "other", "bit"])
def test_a_damaged_entry_is_dropped_and_told_once(
    how: str, tmp_path: Path, seed: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of two entries, anywhere in them."""
    show_on_stderr(logging.WARNING)
    cache, rng = KernelCache(tmp_path), np.random.default_rng(seed)
    for key in ("a", "b"):
        cache.put(key, b"kernel" * 50)
        path = tmp_path / f"{key}{SUFFIX}"
        path.write_bytes(damaged(path.read_bytes(), how, rng))
        assert cache.get(key) is None
        cache.put(key, b"new" * 50)
        assert cache.get(key) == b"new" * 50
    assert capsys.readouterr().err.count("compiled anew") == 1


def test_a_full_disk_keeps_nothing(tmp_path: Path, limited_files) -> None:
    """And is no error."""
    cache = KernelCache(tmp_path)
    with limited_files(100):
        cache.put("a", b"kernel" * 50)

    assert cache.get("a") is None
    assert not list(tmp_path.iterdir())


def test_jax_keeps_its_kernels_there_and_mends_them(tmp_path: Path) -> None:
    """The whole program: three runs, before the second of which half of every entry is lost."""
    said, results = [], []
    for run in range(3):
        environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_PLATFORMS": "cpu"}
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True
        )
        said.append(done.stderr)
        results.append(done.stdout)
        entries = [path for path in tmp_path.iterdir() if path.is_file()]
        assert entries
        assert all(path.name.endswith(SUFFIX) for path in entries)
        if run == 0:
            for path in entries:
                path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert [text.count("compiled anew") for text in said] == [0, 1, 0]
    assert results == ["85344.0\n"] * 3


class SumsAsImages:
    """A source whose image is a number that a kernel computes."""

    def image(self, key: ImageKey) -> float:  # noqa: ARG002
        """28."""
        number = float(jax.jit(lambda x: x.sum())(jax.numpy.arange(8.0)))
        assert number == 28.0
        return number


SUMS: Any = SumsAsImages()


def test_worker_processes_keep_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the command that started them."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    with local_processes(1) as executor:
        assert executor.submit(judge_image, SUMS, ImageKey("sum", 0, 0), ()).result() == []

    assert any(path.name.endswith(SUFFIX) for path in tmp_path.iterdir())


def test_a_worker_lives_without_a_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """What needs one says so in one line; a worker that ends is told as killed for memory."""
    monkeypatch.setenv("JAX_PLATFORMS", "nowhere")
    with local_processes(1) as executor:
        assert executor.submit(math.sqrt, 4.0).result() == 2.0
        with pytest.raises(PipelineError, match="JAX finds no device"):
            executor.submit(judge_image, SUMS, ImageKey("sum", 0, 0), ()).result()


def test_a_command_without_a_run_keeps_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not only those whose stages set JAX up."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "kernels"))
    subprocess.run(
        [sys.executable, "-m", "pipeline", "synth", "occlusion", str(tmp_path / "out"), "--quiet"],
        cwd=Path(__file__).parents[2],
        check=True,
    )

    assert any(path.name.endswith(SUFFIX) for path in (tmp_path / "kernels").iterdir())


def test_traces_of_the_oldest_versions_are_dropped(tmp_path: Path) -> None:
    """Those of a few versions stay, and what a version has is found again."""
    for version in range(MOST_VERSIONS + 2):
        trace_cache(tmp_path, f"{version}").put("key", b"trace")
        os.utime(tmp_path / "traces" / f"{version}", (1000, 1000 + version))

    assert len(list((tmp_path / "traces").iterdir())) == MOST_VERSIONS
    assert trace_cache(tmp_path, f"{MOST_VERSIONS + 1}").get("key") == b"trace"
    assert trace_cache(tmp_path, "0").get("key") is None


TRACED = """
from pipeline.jax_setup import set_up_jax
set_up_jax()
import numpy as np
from shapes.rendering import depth_rendering
from shapes.rendering.object_library import library_of_mesh
from pipeline.synthesis.objects import built_in_object
from shapes.rendering.ray_casting import PosedObjects
from shapes.geometry.camera import Camera
import jax
seen, render_tiles = [], depth_rendering.render_tiles
depth_rendering.render_tiles = lambda *given: seen.append(given) or render_tiles(*given)
mesh = built_in_object("mug")
library = library_of_mesh(mesh.vertices, mesh.faces, 0.01)
pose = np.eye(4, dtype=np.float32)[None]
pose[0, 2, 3] = 0.5
camera = jax.tree.map(lambda value: np.full(1, value, np.float32), Camera(60.0, 60.0, 15.5, 11.5))
posed = PosedObjects(np.zeros(1, np.int32), pose, np.zeros(1, np.int32))
image = np.asarray(depth_rendering.render_layers(library, posed, camera, 24, 32))
print(len(seen), np.isfinite(image).sum(), image[np.isfinite(image)].sum())
"""


def test_a_second_process_does_not_trace(tmp_path: Path) -> None:
    """It computes the same; a damaged trace is made anew."""

    def told() -> list[str]:
        result = subprocess.run(
            [sys.executable, "-c", TRACED],
            env={**os.environ, "JAX_COMPILATION_CACHE_DIR": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        )
        return result.stdout.split()

    first, second = told(), told()
    for trace in tmp_path.glob(f"traces/*/*{SUFFIX}"):
        trace.write_bytes(trace.read_bytes()[:100])
    third = told()

    assert int(first[1]) > 0
    assert first[1:] == second[1:] == third[1:]
    assert (int(first[0]) > 0, int(second[0]), int(third[0]) > 0) == (True, 0, True)
