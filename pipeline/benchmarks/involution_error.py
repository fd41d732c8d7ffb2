"""How exactly moves of the scene sampler are their own inverse."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from scene.mcmc.involution import Move, draw
from scene.mcmc.kernel import Kernel, run_block
from scene.mcmc.random_variates import Variates
from scene.model.posterior import ChainState, SceneModel
from scene.model.scene_graph import SceneGraph, tree_code


def largest_involution_error(
    key: jax.Array, model: SceneModel, kernel: Kernel, states: ChainState, sweeps: int
) -> tuple[float, NDArray[np.int32]]:
    """Largest difference between (s, a) and what applying h twice returns, of all moves by an involution.

    Log weights are compared, too. And the graphs (sweeps, B), by `tree_code`, from which moves were drawn.

    Args:
        key: random key.
        model: the target.
        kernel: the moves.
        states: (B, ...) from which chains walk.
        sweeps: of these; after each, one of every move is drawn.
    """
    walk_key, draw_key = jax.random.split(key)
    _, visited, _ = run_block(walk_key, states, model, kernel, sweeps, _itself)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), visited)
    moves = [*([kernel.structure] if kernel.structure else []), *kernel.others]
    keys = jax.random.split(draw_key, len(moves))
    worst = max(
        float(jnp.max(_errors(one, model, move, flat))) for one, move in zip(keys, moves, strict=True)
    )
    return worst, np.asarray(jax.vmap(jax.vmap(tree_code))(visited.scene.parents))


def _itself(state: ChainState) -> ChainState:
    return state


@jax.jit
def _errors(key: jax.Array, model: SceneModel, move: Move, states: ChainState) -> jax.Array:
    """Errors (B,) of one draw from each of B states."""
    dtype, lead = states.log_prior.dtype, states.log_prior.shape
    dice = Variates.draw(key, lead, move.objects + move.uniforms, move.normals, dtype)
    return jax.vmap(partial(_error, model, move))(dice, states)


def _error(model: SceneModel, move: Move, dice: Variates, state: ChainState) -> jax.Array:
    scene = state.scene
    chosen, context, auxiliary = draw(dice, model, move, scene)
    there, reverse, log_jacobian = move.involution(model, scene, chosen, auxiliary)
    back, again, log_jacobian_back = move.involution(model, there, chosen, reverse)
    context_there = move.context(model, there, chosen)
    log_there = move.log_density(context, reverse) - move.log_density(context, auxiliary) + log_jacobian
    log_back = move.log_density(context_there, again) - move.log_density(context_there, reverse)
    log_back += log_jacobian_back + model.log_prior(back) - state.log_prior
    asymmetry = jnp.where(jnp.isfinite(log_there), jnp.abs(log_there + log_back), 0)
    return jnp.maximum(_difference(scene, back), asymmetry)


def _difference(first: SceneGraph, second: SceneGraph) -> jax.Array:
    """Largest difference of two scenes; a different edge or face counts as infinite."""
    same = (
        jnp.all(first.parents == second.parents)
        & jnp.all(first.child_faces == second.child_faces)
        & jnp.all(first.parent_faces == second.parent_faces)
        & jnp.all(first.present == second.present)
    )
    sign = jnp.sign(jnp.sum(first.poses[:, :4] * second.poses[:, :4], axis=1, keepdims=True))
    rotation = jnp.max(jnp.abs(first.poses[:, :4] - sign * second.poses[:, :4]))
    translation = jnp.max(jnp.abs(first.poses[:, 4:] - second.poses[:, 4:]))
    return jnp.where(same, jnp.maximum(rotation, translation), jnp.inf)
