"""The structure sampler against enumeration: total variation after a given number of moves.

The model is the special configuration of docs/model.md, section O, with a number for every tree in place of
the renderer: the same for all (no data), and at random (data). The kernel is the one that parses scenes.
Independent draws from the exact distribution set the floor.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from pipeline.benchmarks.cubes import code_of, cube_kernel, cube_model, start_chains
from pipeline.benchmarks.enumerated_target import GraphTable
from pipeline.benchmarks.involution_error import largest_involution_error
from pipeline.progress import Report
from scene.mcmc.kernel import run_block
from scene.model.posterior import ChainState, SceneModel
from scene.model.scene_graph import all_trees, tree_code

OBJECTS = (2, 3, 4)
CHAINS, GROUPS = 256, 2
"""Chains that are compiled together, and groups of them that run side by side."""
BLOCKS = 20
"""Parts of the run, whose sweeps are compiled together."""
BURN_IN = 48
"""Sweeps at least that are dropped, by whole parts."""
CANDIDATES, REPEATS = 3, 1
"""Poses that are weighed together, and such moves a sweep: cubes mix sooner where more are carried along."""
VERIFIED_CHAINS, VERIFIED_SWEEPS = 64, 40


@dataclass(frozen=True, kw_only=True)
class SamplerFigures:
    """One number of objects.

    Attributes:
        total_variation: of the chains' tree frequencies from the enumerated prior, likelihood constant.
        independent_draws: the same of as many independent draws.
        with_data: total variation from the posterior under standard normal log likelihoods of the trees.
        seconds: of the chains without data, burn-in included, after compiling.
        compile_s: before.
        involution_error: largest |h(h(z)) - z|, log weight included.
        trees: how many there are.
    """

    total_variation: float
    independent_draws: float
    with_data: float
    seconds: float
    compile_s: float
    involution_error: float
    trees: int


def measure_sampler(seed: int, moves: int, report: Report) -> dict[int, SamplerFigures]:
    """Figures by number of objects; `report` is told how many of how many are done."""
    figures = {}
    for index, count in enumerate(OBJECTS):
        report(index, len(OBJECTS))
        with jax.enable_x64(True):
            figures[count] = _measure(np.random.default_rng([seed, 71_003, count]), count, moves)
    return figures


def _measure(rng: np.random.Generator, count: int, moves: int) -> SamplerFigures:
    trees = all_trees(count)
    no_data, data = np.zeros(len(trees)), rng.normal(size=len(trees))
    kernel = cube_kernel(count, candidates=CANDIDATES, repeats=REPEATS)
    *start_keys, run_key, data_key, verify_key = jax.random.split(jax.random.key(rng.integers(2**32)), 5)
    models = [
        cube_model(count, likelihood=GraphTable.build(trees, log_values)) for log_values in (no_data, data)
    ]
    states = [
        [start_chains(one, model, CHAINS) for one in jax.random.split(key, GROUPS)]
        for key, model in zip(start_keys, models, strict=True)
    ]

    sweeps = -(-moves // (GROUPS * CHAINS * kernel.moves))
    together = -(-sweeps // BLOCKS)
    dropped = -(-BURN_IN // together)
    started = time.perf_counter()
    block = run_block.lower(run_key, states[0][0], models[0], kernel, together, code_of).compile()
    compiled = time.perf_counter()

    def visits(key: jax.Array, model: SceneModel, state: ChainState) -> NDArray[np.int64]:
        counts = np.zeros(len(trees), np.int64)
        for index in range(dropped + -(-sweeps // together)):
            state, codes, _ = block(jax.random.fold_in(key, index), state, model, kernel)
            if index >= dropped:
                codes, numbers = np.unique(np.asarray(codes), return_counts=True)
                counts += np.where(codes[:, None] == tree_codes, numbers[:, None], 0).sum(axis=0)
        return counts

    def all_visits(key: jax.Array, model: SceneModel, starts: Sequence[ChainState]) -> NDArray[np.int64]:
        with ThreadPoolExecutor(GROUPS) as cores:
            return sum(cores.map(visits, jax.random.split(key, GROUPS), [model] * GROUPS, starts), counts)

    counts = np.zeros(len(trees), np.int64)
    tree_codes = np.asarray(jax.vmap(tree_code)(jnp.asarray(trees)))
    seen = all_visits(run_key, models[0], states[0])
    seconds = time.perf_counter() - compiled
    seen_with_data = all_visits(data_key, models[1], states[1])
    few = jax.tree.map(lambda leaf: leaf[:VERIFIED_CHAINS], states[1][0])
    error, _ = largest_involution_error(verify_key, models[1], kernel, few, VERIFIED_SWEEPS)
    prior = np.full(len(trees), 1 / len(trees))
    return SamplerFigures(
        total_variation=_distance(seen, prior),
        independent_draws=_distance(rng.multinomial(seen.sum(), prior), prior),
        with_data=_distance(seen_with_data, np.exp(data) / np.exp(data).sum()),
        seconds=seconds,
        compile_s=compiled - started,
        involution_error=error,
        trees=len(trees),
    )


def _distance(visits: NDArray[np.integer], posterior: NDArray[np.float64]) -> float:
    """Total variation between frequencies and probabilities."""
    return float(np.abs(visits / visits.sum() - posterior).sum() / 2)


def document_of(figures: dict[int, SamplerFigures]) -> dict[str, Any]:
    """What is printed, by figure and number of objects."""

    def each(name: str) -> dict[str, Any]:
        return {str(count): getattr(one, name) for count, one in figures.items()}

    names = ("total_variation", "independent_draws", "with_data", "involution_error", "trees", "compile_s")
    return {
        **{name: each(name) for name in names},
        "seconds": sum(one.seconds for one in figures.values()),
        "seconds_by_objects": each("seconds"),
    }
