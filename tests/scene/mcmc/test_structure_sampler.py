"""The sampler of scene graphs against enumeration (docs/model.md, section O)."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pipeline.benchmarks.cubes import code_of, cube_kernel, cube_model, start_chains
from pipeline.benchmarks.enumerated_target import GraphTable
from pipeline.benchmarks.involution_error import largest_involution_error
from scene.mcmc import edges
from scene.mcmc.kernel import run_block
from scene.model.posterior import SceneModel
from scene.model.prior import WeightedTrees
from scene.model.scene_graph import ROOT, all_trees, tree_code
from tests.scene.mcmc.tree_frequencies import tree_frequencies
from tests.statistical import assert_mean

CHAINS = 256


def weighted(free: int, *, table: bool = False) -> tuple[SceneModel, np.ndarray]:
    """A model whose p(G) prefers some trees, and its probabilities."""
    trees = all_trees(free, table=table)
    log_p = 1.2 * np.sin(np.arange(len(trees)) * 1.7)
    probabilities = np.exp(log_p) / np.exp(log_p).sum()
    structure = GraphTable.build(trees, np.log(probabilities))
    return cube_model(free, table=table, structure=structure, upward_concentration=2.0), probabilities


def test_every_involution_returns(key: jax.Array) -> None:
    """h(h(z)) = z to 1e-9 with the log weight negated, for all moves from states over all transitions."""
    model, _ = weighted(3, table=True)
    start_key, run_key = jax.random.split(key)
    states = start_chains(start_key, model, 64)

    error, codes = largest_involution_error(run_key, model, cube_kernel(4), states, 40)

    assert len(np.unique(codes)) >= 40  # of 50 trees: all four kinds of transition took place
    assert error < 1e-9


@pytest.mark.parametrize("strength", [pytest.param(0.0, marks=pytest.mark.slow), 1.5])
def test_trees_are_visited_as_often_as_they_are_likely(key: jax.Array, strength: float) -> None:
    """p(G) not uniform, log L[G] constant or not: frequencies are p(G) exp(log L[G]) / sum."""
    model, probabilities = weighted(3)
    trees = all_trees(3)
    log_likelihood = strength * np.cos(np.arange(len(trees)))
    posterior = probabilities * np.exp(log_likelihood)
    model = replace(model, likelihood=GraphTable.build(trees, log_likelihood))

    frequencies, _ = tree_frequencies(key, model, cube_kernel(3), chains=CHAINS, sweeps=300, burn_in=50)

    assert_mean(frequencies, posterior / posterior.sum(), detectable=0.06)


@pytest.mark.slow  # tests/scene/presence returns the prior with absent objects
@pytest.mark.parametrize("weight", [1.0, 0.3])
def test_no_data_returns_the_prior_beside_an_empty_slot(key: jax.Array, weight: float) -> None:
    """Likelihood constant, two objects, a table and a slot for one that is not there: 8 trees.

    Each floating object counts its weight.
    """
    prior = WeightedTrees(jnp.asarray(weight))
    model = cube_model(3, table=True, structure=prior, upward_concentration=2.0)
    start_key, run_key = jax.random.split(key)
    states = start_chains(start_key, model, CHAINS)
    scene = replace(states.scene, present=states.scene.present.at[:, 2].set(False))
    states = replace(states, scene=scene, log_prior=jax.vmap(model.log_prior)(scene))
    trees = np.insert(all_trees(2, table=True), 2, ROOT, axis=1)
    trees[trees == 2] = 3
    weights = weight ** (trees[:, :2] == ROOT).sum(axis=1)

    _, codes, _ = run_block(run_key, states, model, cube_kernel(4), 300, code_of)

    tree_codes = np.asarray(jax.vmap(tree_code)(jnp.asarray(trees)))
    visited = np.asarray(codes)[50:]
    frequencies = np.stack([(visited == code).mean(axis=0) for code in tree_codes], axis=1)
    assert_mean(frequencies, weights / weights.sum(), detectable=0.06)


@pytest.mark.slow  # the frequencies above are right with the factor alone
@pytest.mark.parametrize(("factor", "right"), [(8.0, True), (1.0, False), (64.0, False)])
def test_the_factor_eight_is_seen(
    key: jax.Array, factor: float, right: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """P(all floating) of two objects is 1/3; without the 8, or with it twice, it is not."""
    model = cube_model(2)
    monkeypatch.setattr(edges, "LOG_CONTACT_JACOBIAN", np.log(factor))
    jax.clear_caches()

    frequencies, trees = tree_frequencies(key, model, cube_kernel(2), chains=CHAINS, sweeps=200, burn_in=60)

    jax.clear_caches()
    floating = frequencies[:, (trees == ROOT).all(axis=1)]
    if right:
        assert_mean(floating, [1 / 3], detectable=0.06)
    else:
        assert abs(floating.mean() - 1 / 3) > 0.12
