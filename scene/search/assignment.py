"""Joint assignment of one pose to every object from finite pools: annealed Gibbs sampling of scenes.

The particles are whole scenes. The conditional of one object given the others is exact over its pool: a
pixel shows the nearest of its pose, the others and the background, and each layer's log density there was
computed once. Tempering from hot to cold makes this the supplement's stage K, a search for the maximum.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp

from scene.execution import FAST_COMPILE
from scene.search.support_table import SupportTable
from shapes.stored_kernels import jit_stored


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PoseLayers:
    """N objects with K poses each, over X pixels.

    Attributes:
        depth_m: (N, K, X), +inf where a pose does not cover a pixel.
        log_density: (N, K, X) of the pixel if that pose is what it shows.
        log_alone: (N, K) what a pose adds outside these pixels, where nothing else competes, and the log
            odds of its object being there at all; 0 for the absent object.
        rests: what carries them.
        rest_m: (X,) depth of the background.
        rest_log_density: (X,).
    """

    depth_m: jax.Array
    log_density: jax.Array
    log_alone: jax.Array
    rests: SupportTable
    rest_m: jax.Array
    rest_log_density: jax.Array


@jit_stored(static_argnames=("particles", "sweeps"), compiler_options=FAST_COMPILE)
def choose(
    key: jax.Array, layers: PoseLayers, hot: float, cold: float, particles: int, sweeps: int
) -> tuple[jax.Array, jax.Array]:
    """Choices (particles, N) after annealing from temperature `hot` to `cold`, and their log densities.

    Every particle starts with the last pose of each pool, by convention that of an absent object.
    """
    count, poses = layers.log_alone.shape
    temperatures = hot * (cold / hot) ** jnp.linspace(0, 1, sweeps)

    def sweep(choice: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        key, temperature = step

        def update(index: jax.Array, choice: jax.Array) -> jax.Array:
            keys = jax.random.split(jax.random.fold_in(key, index), particles)
            log_given = jax.vmap(lambda c: log_conditional(layers, c, index))(choice)
            drawn = jax.vmap(jax.random.categorical)(keys, log_given / temperature)
            return choice.at[:, index].set(drawn)

        return jax.lax.fori_loop(0, count, update, choice), None

    start = jnp.full((particles, count), poses - 1)
    choice, _ = jax.lax.scan(sweep, start, (jax.random.split(key, sweeps), temperatures))
    return choice, jax.vmap(partial(log_density_of_choice, layers))(choice)


@partial(jax.jit, static_argnames="candidates")
def improve_pairs(layers: PoseLayers, choice: jax.Array, candidates: int) -> jax.Array:
    """The choice (N,) after every two objects, one of them there, got the best joint poses given the others.

    Two that took each other's places cannot leave them one by one. The joint is exact over the
    `candidates` best poses of each, given the others without the two, and what they have.
    """
    objects = jnp.arange(len(layers.log_alone))

    def improve(choice: jax.Array, pair: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        neither = jnp.all(choice[jnp.stack(pair)] == no_object(layers))
        return jax.lax.cond(neither, lambda choice, *_: choice, put, choice, *pair), None

    def put(choice: jax.Array, a: jax.Array, b: jax.Array) -> jax.Array:
        others = nearest_layer(layers, choice, (objects != a) & (objects != b))
        places = [_best_given(layers, others, choice, one, candidates) for one in (a, b)]
        pair = (a, places[0]), (b, places[1])
        joint = _joint_log_density(layers, others, *pair) + layers.rests.of_pair(choice, *pair)
        best = jnp.unravel_index(jnp.argmax(joint), joint.shape)
        return choice.at[a].set(places[0][best[0]]).at[b].set(places[1][best[1]])

    return jax.lax.scan(improve, choice, jnp.triu_indices(len(objects), 1))[0]


def _best_given(
    layers: PoseLayers, others: tuple[jax.Array, jax.Array], choice: jax.Array, one: jax.Array, count: int
) -> jax.Array:
    """Places (at most `count`) of an object's best poses before a front, the chosen one first, none last.

    Whether they rest on anything is left open.
    """
    absent = no_object(layers)
    _, best = jax.lax.top_k(gain_before(layers, others, one), min(count - 2, absent))
    return jnp.concatenate([choice[one][None], best, jnp.full(1, absent)])


def gain_before(layers: PoseLayers, front: tuple[jax.Array, jax.Array], one: jax.Array) -> jax.Array:
    """Log density (K,) that each pose of an object adds before a front, its depth and log density (X,).

    Without what carries it.
    """
    return gain_of(front, layers.depth_m[one], layers.log_density[one], layers.log_alone[one])


def gain_of(
    front: tuple[jax.Array, jax.Array], depth_m: jax.Array, log_density: jax.Array, log_alone: jax.Array
) -> jax.Array:
    """Log density (K,) that each of K poses adds before a front of depth and log density (2) (X,).

    Args:
        front: of the others.
        depth_m: (K, X) of the poses.
        log_density: (K, X) where they are seen.
        log_alone: (K,) what they add whatever the others are.
    """
    front_m, log_front = front
    nearer = depth_m < front_m[None]
    return jnp.sum(jnp.where(nearer, log_density - log_front[None], 0.0), axis=1) + log_alone


def _joint_log_density(
    layers: PoseLayers,
    others: tuple[jax.Array, jax.Array],
    one: tuple[jax.Array, jax.Array],
    other: tuple[jax.Array, jax.Array],
) -> jax.Array:
    """Log density (A, B) of two objects, each given with its places, before the front of the others.

    Without what carries them.
    """
    (a, a_places), (b, b_places) = one, other
    b_m, b_log = layers.depth_m[b, b_places], layers.log_density[b, b_places]

    def row(place: jax.Array) -> jax.Array:
        behind_m, behind = others
        nearer = layers.depth_m[a, place] < behind_m
        behind_m = jnp.where(nearer, layers.depth_m[a, place], behind_m)
        behind = jnp.where(nearer, layers.log_density[a, place], behind)
        shown = jnp.where(b_m < behind_m[None], b_log, behind[None])
        return jnp.sum(shown, axis=1) + layers.log_alone[a, place]

    return jax.lax.map(row, a_places) + layers.log_alone[b, b_places][None]


def log_density_of_choice(layers: PoseLayers, choice: jax.Array) -> jax.Array:
    """Log density of the observation under one choice (N,)."""
    _, shown = nearest_layer(layers, choice, jnp.ones(len(choice), bool))
    alone = jnp.sum(layers.log_alone[jnp.arange(len(choice)), choice])
    return jnp.sum(shown) + alone + jnp.sum(layers.rests.of(choice))


def log_conditional(layers: PoseLayers, choice: jax.Array, index: jax.Array) -> jax.Array:
    """Log density (K,) of each pose of one object given the others' choice."""
    others_m, others = nearest_layer(layers, choice, jnp.arange(len(choice)) != index)

    def shown(pose: tuple[jax.Array, jax.Array]) -> jax.Array:
        depth_m, log_density = pose
        return jnp.sum(jnp.where(depth_m < others_m, log_density, others))

    # one pose after the other: particles side by side find it in the cache
    by_pose = jax.lax.map(shown, (layers.depth_m[index], layers.log_density[index]))
    return by_pose + layers.log_alone[index] + layers.rests.given(choice, index)


def no_object(layers: PoseLayers) -> int:
    """The place of the absent object in every pool, the last."""
    return layers.log_alone.shape[1] - 1


def nearest_layer(layers: PoseLayers, choice: jax.Array, use: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Depth and log density (X,) of the nearest layer of the objects in use, background included."""
    objects = jnp.arange(len(choice))
    depths = jnp.where(use[:, None], layers.depth_m[objects, choice], jnp.inf)
    nearest = jnp.argmin(depths, axis=0)
    front_m = jnp.min(depths, axis=0)
    density = jnp.take_along_axis(layers.log_density[objects, choice], nearest[None], axis=0)[0]
    covered = front_m < layers.rest_m
    return jnp.minimum(front_m, layers.rest_m), jnp.where(covered, density, layers.rest_log_density)
