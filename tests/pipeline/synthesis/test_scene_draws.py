"""Scenes drawn from the prior of supplement O."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pipeline.benchmarks.cubes import cube_model
from pipeline.synthesis.scene_draws import drawn_parents, drawn_scene
from scene.model.prior import WeightedTrees, log_prior
from scene.model.scene_graph import all_trees
from tests.statistical import assert_frequencies


@pytest.mark.parametrize("weight", [1.0, 0.3])
def test_trees_are_as_frequent_as_their_weights_say(weight: float, seed: int) -> None:
    """Three objects on a table or in the air, all 50 trees; a false alarm in 1e-6."""
    rng, trees = np.random.default_rng(seed), all_trees(3, table=True)
    movable, present = jnp.arange(4) < 3, jnp.ones(4, bool)
    prior = WeightedTrees(jnp.asarray(weight))
    expected = np.exp([float(prior.log_density(jnp.asarray(tree), present, movable)) for tree in trees])

    drawn = np.stack([drawn_parents(rng, 3, 1, weight) for _ in range(6_000)])

    counts = [(drawn == tree).all(axis=1).sum() for tree in trees]
    assert sum(counts) == len(drawn)
    assert_frequencies(counts, expected / expected.sum())


@pytest.mark.usefixtures("double_precision")
def test_drawn_scenes_are_possible(seed: int) -> None:
    """Each has a prior density; what carries is placed before what it carries."""
    rng, model = np.random.default_rng(seed), cube_model(3, table=True)
    slab = np.array([[1.0, 0, 0, 0, 0, 0, 0]])
    log_density = jax.jit(log_prior)
    for _ in range(20):
        scene = drawn_scene(rng, model.prior, model.bodies, slab, 1.0)
        assert np.isfinite(log_density(model.prior, WeightedTrees.uniform(), model.bodies, scene))
