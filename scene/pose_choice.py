"""The joint choice of one pose for every object, from a finite pool: annealed Gibbs sampling of scenes.

The particles are whole scenes. The conditional of one object given the others is exact over its pool: a
pixel shows the nearest of its pose, the others and the background, and each layer's log density there was
computed once. Tempering from hot to cold makes this the supplement's stage K, a search for the maximum.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PoseLayers:
    """N objects with K poses each, over X pixels.

    Attributes:
        depth_m: (N, K, X), +inf where a pose does not cover a pixel.
        log_density: (N, K, X) of the pixel if that pose is what it shows.
        log_alone: (N, K) what a pose adds outside these pixels, where nothing else competes.
        rest_m: (X,) depth of the background.
        rest_log_density: (X,).
    """

    depth_m: jax.Array
    log_density: jax.Array
    log_alone: jax.Array
    rest_m: jax.Array
    rest_log_density: jax.Array


@partial(jax.jit, static_argnames=("particles", "sweeps"))
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


def log_density_of_choice(layers: PoseLayers, choice: jax.Array) -> jax.Array:
    """Log density of the observation under one choice (N,)."""
    _, shown = _front(layers, choice, jnp.ones(len(choice), bool))
    return jnp.sum(shown) + jnp.sum(layers.log_alone[jnp.arange(len(choice)), choice])


def log_conditional(layers: PoseLayers, choice: jax.Array, index: jax.Array) -> jax.Array:
    """Log density (K,) of each pose of one object given the others' choice."""
    others_m, others = _front(layers, choice, jnp.arange(len(choice)) != index)
    nearer = layers.depth_m[index] < others_m[None]
    shown = jnp.where(nearer, layers.log_density[index], others[None])
    return jnp.sum(shown, axis=1) + layers.log_alone[index]


def _front(layers: PoseLayers, choice: jax.Array, use: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Depth and log density (X,) of the nearest layer of the objects in use, background included."""
    objects = jnp.arange(len(choice))
    depths = jnp.where(use[:, None], layers.depth_m[objects, choice], jnp.inf)
    nearest = jnp.argmin(depths, axis=0)
    front_m = jnp.min(depths, axis=0)
    density = jnp.take_along_axis(layers.log_density[objects, choice], nearest[None], axis=0)[0]
    behind = layers.rest_m < front_m
    return jnp.minimum(front_m, layers.rest_m), jnp.where(behind, layers.rest_log_density, density)
