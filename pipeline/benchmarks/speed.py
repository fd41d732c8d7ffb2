"""Hypotheses rendered and scored a second, beside Embree with NumPy on the same poses.

Every call gets poses that were never seen before, results reach the host, and compile time is apart. What is
called is what `parse` calls: refinement scores poses by `log_likelihood_ratio`; the search asks for layers by
`render_layers`, and the chains keep the same in tiles.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from pipeline.benchmarks.hypotheses import BACKGROUND_M, NOISE, Problem, posed, problem
from pipeline.benchmarks.lathe import mug
from pipeline.benchmarks.roofline import measure_roofline
from pipeline.progress import Report
from scene.likelihood.one_object import gain_over_rest, log_likelihood_ratio
from shapes.rendering.depth_rendering import render_layers
from shapes.rendering.object_library import join, library_of_mesh

SIDES = (50, 100, 200)
OBJECTS = (1, 2, 5, 10)
VOXELS = (2**15, 2**18, 2**20, 2**22)
HYPOTHESES = {50: 8192, 100: 4096, 200: 1024}
"""Of one call: enough that starting it costs nothing."""
ROUNDS = 5
PEER_HYPOTHESES = 256
Rate = dict[str, float]


def measure_speed(seed: int, report: Report) -> dict[str, Any]:
    """All figures of `bench speed`; `report` is told how many of how many are done."""
    rng = np.random.default_rng([seed, 20_403])
    vertices, faces = mug()
    library = library_of_mesh(vertices, faces)
    problems = {side: problem(library, side, rng) for side in SIDES}
    steps = iter(range(1, 100))
    total = 1 + 3 * len(SIDES) + len(OBJECTS) + len(VOXELS) + len(SIDES)

    def told(figure: Any) -> Any:
        report(next(steps), total)
        return figure

    compile_s = told(compile_seconds(problems[SIDES[-1]], rng))
    by_side = {str(side): told(likelihood_rate(problems[side], rng)) for side in SIDES}
    layers = {str(side): told(layer_rate(problems[side], rng)) for side in SIDES}
    roofline = {str(side): told(measure_roofline(problems[side], rng)) for side in SIDES}
    crowds = {count: problem(join([library] * count), SIDES[1], rng) for count in OBJECTS}
    one_moved = {str(count): told(likelihood_rate(crowd, rng)) for count, crowd in crowds.items()}
    by_voxels = {}
    for voxels in VOXELS:
        pitch_m = float(library.pitch_m[0]) * (np.prod(np.asarray(library.size[0])) / voxels) ** (1 / 3)
        other = library_of_mesh(vertices, faces, pitch_m)
        by_voxels[str(voxels)] = told(likelihood_rate(problem(other, SIDES[1], rng), rng))
    peer = {str(side): told(embree_rates(problems[side], rng)) for side in SIDES}
    return {
        "device": jax.devices()[0].device_kind,
        "hypotheses_per_second": {side: rate["median"] for side, rate in by_side.items()},
        "embree_per_second": {side: one.get("whole_image", {}).get("median") for side, one in peer.items()},
        "compile_s": compile_s["first"],
        "trace_s": compile_s["traced"],
        "compile_cached_s": compile_s["cached"],
        "spread": {
            "hypotheses_per_second": by_side,
            "layers_per_second": layers,
        },
        "roofline": roofline,
        "growth": {
            "objects_one_moved_per_second": one_moved,
            "voxels_per_second": by_voxels,
        },
        "embree": peer,
    }


def likelihood_rate(task: Problem, rng: np.random.Generator) -> Rate:
    """Hypotheses of one object a second: rendered, and scored against the image."""
    count = HYPOTHESES[task.intrinsics.width]

    def score(hypotheses: Any) -> NDArray[np.float32]:
        return log_likelihood_ratio(task.library, NOISE, task.evidence, hypotheses)

    return _rate(score, lambda: task.hypotheses(rng, count), count)


def layer_rate(task: Problem, rng: np.random.Generator) -> Rate:
    """Depth layers a second, as the search of `parse` asks for them."""
    count = HYPOTHESES[task.intrinsics.width] // 8
    height, width = task.evidence.height, task.evidence.width

    def covered(hypotheses: Any) -> jax.Array:
        layers = render_layers(task.library, hypotheses, task.evidence.cameras, height, width)
        return jnp.isfinite(layers).sum(axis=(1, 2))

    return _rate(covered, lambda: task.hypotheses(rng, count), count)


def embree_rates(task: Problem, rng: np.random.Generator) -> dict[str, Any]:
    """The peer's hypotheses a second in its best setting, or the reason why there is no figure."""
    try:
        from pipeline.peers.embree_scoring import EmbreeScorer
    except ImportError as error:
        return {"skipped": f"no Open3D here ({error})"}
    vertices, faces = mug()
    scorer = EmbreeScorer(vertices, faces, task.intrinsics, NOISE, task.observed_m, BACKGROUND_M)
    poses = task.poses(rng, 32)
    ours = np.asarray(
        log_likelihood_ratio(task.library, NOISE, task.evidence, posed(poses, np.zeros(len(poses)))),
        np.float64,
    )
    gap = float(np.median(np.abs(ours - scorer.whole_image(poses))))
    count = PEER_HYPOTHESES * 50 // task.intrinsics.width
    rates: dict[str, Any] = {"median_difference_nat": gap}
    for name, score, settings in (
        ("whole_image", scorer.whole_image, (1, 8, 32)),
        ("under_sphere", scorer.under_sphere, (16, 64, 256)),
    ):
        tried = [
            _rate(partial(score, together=together), lambda: task.poses(rng, count), count)
            for together in settings
        ]
        rates[name] = max(tried, key=lambda rate: rate["median"])
    return rates


def compile_seconds(task: Problem, rng: np.random.Generator) -> dict[str, float]:
    """Seconds for the likelihood at the largest size: `first` from nothing to the kernel, then apart.

    `traced` is tracing and lowering, which is paid where no trace is kept; `cached` the compile phase after
    it, from the kept cache.
    """
    arguments = (task.library, NOISE, task.evidence, task.hypotheses(rng, HYPOTHESES[task.intrinsics.width]))
    seconds = {}
    with tempfile.TemporaryDirectory() as folder, _cache_in(folder):
        for run in ("first", "cached"):
            jax.clear_caches()
            begun = time.perf_counter()
            lowered = jax.jit(gain_over_rest.function).lower(*arguments)
            seconds["traced"] = time.perf_counter() - begun
            lowered.compile()
            seconds[run] = time.perf_counter() - begun
    return {**seconds, "cached": seconds["cached"] - seconds["traced"]}


@contextmanager
def _cache_in(folder: str) -> Iterator[None]:
    """Compiled kernels are kept in another folder, empty at first."""
    from jax.experimental.compilation_cache import compilation_cache

    kept = jax.config.values["jax_compilation_cache_dir"]
    try:
        jax.config.update("jax_compilation_cache_dir", folder)
        compilation_cache.reset_cache()
        yield
    finally:
        jax.config.update("jax_compilation_cache_dir", kept)
        compilation_cache.reset_cache()


def _rate(score: Callable[[Any], Any], draw: Callable[[], Any], count: int) -> Rate:
    """Results a second over `ROUNDS` calls, each with inputs of its own, after one that is not timed."""
    rates = []
    for turn in range(ROUNDS + 1):
        inputs = jax.block_until_ready(draw())
        begun = time.perf_counter()
        results = np.asarray(score(inputs))
        seconds = time.perf_counter() - begun
        assert results.shape == (count,)
        assert np.isfinite(results).all()
        if turn:
            rates.append(count / seconds)
    return {"median": statistics.median(rates), "least": min(rates), "most": max(rates)}
