"""How often chains over cubes visit each tree."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from pipeline.benchmarks.cubes import code_of, start_chains
from scene.mcmc.kernel import Kernel, run_block
from scene.model.posterior import ChainState, SceneModel
from scene.model.scene_graph import all_trees, tree_code


def tree_frequencies(
    key: jax.Array,
    model: SceneModel,
    kernel: Kernel,
    *,
    chains: int,
    sweeps: int,
    burn_in: int,
    record: Callable[[ChainState], jax.Array] = code_of,
) -> tuple[np.ndarray, np.ndarray]:
    """Share of sweeps (chains, T) that end in each of the trees (T, C), for each chain."""
    movable = np.asarray(model.bodies.movable)
    trees = all_trees(int(movable.sum()), table=not movable.all())
    start_key, run_key = jax.random.split(key)
    states = start_chains(start_key, model, chains)
    _, codes, _ = run_block(run_key, states, model, kernel, sweeps, record)
    codes = np.asarray(codes)[burn_in:]
    tree_codes = np.asarray(jax.vmap(tree_code)(jnp.asarray(trees)))
    return np.stack([(codes == code).mean(axis=0) for code in tree_codes], axis=1), trees
