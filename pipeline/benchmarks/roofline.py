"""What the machine's own rates allow: an upper bound on hypotheses rendered and scored a second.

Whatever the order of work, each pixel that the object covers is looked up in the distance field once at
least, and gets one density; the rest (finding those pixels, stepping to the surface, summing) is left out.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from pipeline.benchmarks.hypotheses import NOISE, Problem
from shapes import depth_noise
from shapes.depth_rendering import render_layers

COUNT = 2**22
"""Look-ups, densities or additions of one measurement: as many as keep every core busy."""
ROUNDS = 5
VIEWS = 64
BYTES = 4 + 3 * 4
"""Of a covered pixel: a packed voxel; the observed depth, the rest's depth and the rest's density."""
OPERATIONS = 120
"""Of a covered pixel, counted in the source: ray and voxel 30, tangent plane and step 40, density 50."""


def measure_roofline(task: Problem, rng: np.random.Generator) -> dict[str, float]:
    """Rates a second of this machine, the pixels that a hypothesis covers, and the bound that they imply."""
    table = task.library.table
    place = jnp.asarray(rng.integers(0, len(table), COUNT), jnp.int32)
    values = jnp.asarray(rng.uniform(0.5, 0.7, COUNT), jnp.float32)
    lookups = _rate(jax.jit(lambda x: table.at[x].get(mode="promise_in_bounds")), place)
    densities = _rate(jax.jit(lambda x: depth_noise.log_density(NOISE, x, 0.6 + 0.1 * x)), values)
    scatters = _rate(jax.jit(lambda x: jnp.zeros(len(table), jnp.float32).at[x].min(0.5)), place)
    views = task.hypotheses(rng, VIEWS)
    height, width = task.evidence.height, task.evidence.width
    layers = render_layers(task.library, views, task.evidence.cameras, height, width)
    covered = float(jnp.isfinite(layers).sum()) / VIEWS
    return {
        "lookups_per_second": lookups,
        "densities_per_second": densities,
        "scatters_per_second": scatters,
        "covered_pixels": covered,
        "bytes": covered * BYTES,
        "operations": covered * OPERATIONS,
        "bound_per_second": 1.0 / (covered * (1.0 / lookups + 1.0 / densities)),
    }


def _rate(work: Callable[[jax.Array], jax.Array], inputs: jax.Array) -> float:
    jax.block_until_ready(work(inputs))
    seconds = []
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        jax.block_until_ready(work(inputs))
        seconds.append(time.perf_counter() - begun)
    return len(inputs) / min(seconds)
