"""What the machine's own rates allow: upper bounds on hypotheses rendered and scored a second.

Two bounds. Whatever the order of work, each pixel that the object covers is looked up in the distance field
once at least, and gets one density. And by sphere tracing, each ray makes the looks that it needs to get to
the surface or past it, at the rate at which this machine makes them when nothing else is to be done. Finding
the tiles, sorting out the rays that are done, and summing are left out of both.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from pipeline.benchmarks.hypotheses import NOISE, Problem
from shapes import depth_noise
from shapes.rendering.depth_rendering import render_layers
from shapes.rendering.ray_casting import CONE_STEPS, STEPS, Rays, advance, free_depth, image_rays, tile_rays
from shapes.rendering.tiles import TILE_PIXELS, tile_counts

COUNT = 2**22
"""Look-ups, densities or additions of one measurement: as many as keep every core busy."""
ROUNDS = 5
VIEWS = 64
DENSE_STEPS = 16
"""Looks a ray in the measurement of their rate."""
BYTES = 8 + 3 * 4
"""Of a covered pixel: the two planes of a voxel; observed depth, the depth of the rest and its density."""
OPERATIONS = 120
"""Of a covered pixel, counted in the source: ray and voxel 30, tangent plane and step 40, density 50."""


def measure_roofline(task: Problem, rng: np.random.Generator) -> dict[str, float]:
    """Rates a second of this machine, what a hypothesis needs, and the bounds that they imply."""
    table = task.library.table
    place = jnp.asarray(rng.integers(0, len(table), COUNT), jnp.int32)
    values = jnp.asarray(rng.uniform(0.5, 0.7, COUNT), jnp.float32)
    lookups = _rate(jax.jit(lambda x: table.at[x].get(mode="promise_in_bounds")), place)
    densities = _rate(jax.jit(lambda x: depth_noise.log_density(NOISE, x, 0.6 + 0.1 * x)), values)
    scatters = _rate(jax.jit(lambda x: jnp.zeros(len(table), jnp.float32).at[x].min(0.5)), place)
    covered = _covered_pixels(task, rng)
    cast, looks, looked = _looks(task, rng)
    return {
        "lookups_per_second": lookups,
        "densities_per_second": densities,
        "scatters_per_second": scatters,
        "looks_per_second": looked,
        "covered_pixels": covered,
        "cast_pixels": cast,
        "looks": looks,
        "bytes": covered * BYTES,
        "operations": covered * OPERATIONS,
        "bound_per_second": 1.0 / (covered * (1.0 / lookups + 1.0 / densities)),
        "tracing_bound_per_second": 1.0 / (looks / looked + cast / densities),
    }


def _covered_pixels(task: Problem, rng: np.random.Generator) -> float:
    """Pixels of a hypothesis's silhouette."""
    height, width = task.evidence.height, task.evidence.width
    layers = render_layers(task.library, task.hypotheses(rng, VIEWS), task.evidence.cameras, height, width)
    return float(jnp.isfinite(layers).sum()) / VIEWS


def _looks(task: Problem, rng: np.random.Generator) -> tuple[float, float, float]:
    """Pixels that a hypothesis casts, the looks that these and their tiles need, and looks a second."""
    table, evidence = task.library.table, task.evidence
    views = task.hypotheses(rng, VIEWS)
    down, across = tile_counts(evidence.height, evidence.width)
    view, row, column = jnp.asarray(np.indices((VIEWS, down, across)).reshape(3, -1), jnp.int32)
    rays = tile_rays(image_rays(task.library, views, evidence.cameras), view, row, column)
    free = free_depth(table, rays)
    near = np.flatnonzero(np.isfinite(np.asarray(free)))
    rays, free = jax.tree.map(lambda leaf: leaf[near, None], (rays, free))
    step = jax.jit(partial(_one_look, table))
    depth, needed = jnp.broadcast_to(free, (len(near), TILE_PIXELS)), len(near) * CONE_STEPS
    for _ in range(sum(STEPS)):
        needed += int(jnp.isfinite(depth).sum())
        depth = step(rays, depth)
    seconds = _seconds(lambda: _densely(table, rays, free))
    cast = len(near) * TILE_PIXELS
    return cast / VIEWS, needed / VIEWS, cast * DENSE_STEPS / seconds


def _one_look(table: jax.Array, rays: Rays, depth: jax.Array) -> jax.Array:
    """Depths (B, TILE_PIXELS) after one look; +inf for rays that are done."""
    number = jnp.arange(TILE_PIXELS, dtype=jnp.int32)[None]
    reached = advance(table, rays, number, depth, 1)
    return jnp.where(jnp.isfinite(depth) & (reached >= 0), reached, jnp.inf)


@jax.jit
def _densely(table: jax.Array, rays: Rays, free: jax.Array) -> jax.Array:
    number = jnp.arange(TILE_PIXELS, dtype=jnp.int32)[None]
    start = jnp.broadcast_to(free, (len(free), TILE_PIXELS))
    return advance(table, rays, number, start, DENSE_STEPS)


def _rate(work: Callable[[jax.Array], jax.Array], inputs: jax.Array) -> float:
    return len(inputs) / _seconds(lambda: work(inputs))


def _seconds(work: Callable[[], jax.Array]) -> float:
    """The least of several runs, after one that compiles."""
    jax.block_until_ready(work())
    seconds = []
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        jax.block_until_ready(work())
        seconds.append(time.perf_counter() - begun)
    return min(seconds)
