"""Which objects are there: scenes compared as a whole, with objects added, taken away and put for others.

Every object costs the log odds of being there at all, in one pose of the many that it might have had (part of
the layers), and earns what it explains better than the others and what is unknown do. An object's posterior
odds compare the scene with the best one without it, in which others may have taken its place. Poses that no
pixel shows (`scene.hidden`) leave the prior odds as they are.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from scene.execution import FAST_COMPILE
from scene.search.assignment import (
    PoseLayers,
    gain_before,
    improve_pairs,
    log_density_of_choice,
    nearest_layer,
    no_object,
)
from shapes.stored_kernels import jit_stored

REPLACING = 8
"""Poses of each object that are tried in the place of others."""


@jit_stored(static_argnames=("candidates",), compiler_options=FAST_COMPILE)
def best_scene(layers: PoseLayers, choice: jax.Array, candidates: int) -> tuple[jax.Array, jax.Array]:
    """The best scene (N,) found from one (N,), and its log density.

    Pairs try the `candidates` best poses of each object.
    """
    choice = filled(layers, choice, jnp.zeros(len(choice), bool))
    choice = improve_pairs(layers, choice, candidates)
    choice = _without_any(layers, _with_replacements(layers, choice))
    return choice, log_density_of_choice(layers, choice)


@jit_stored(compiler_options=FAST_COMPILE)
def rivals(layers: PoseLayers, choice: jax.Array, copies: jax.Array) -> tuple[jax.Array, jax.Array]:
    """For every object the best scene (N, N) without it, or with it where it is absent; its log odds (N,).

    Both are sought next to the scene (N,), by leaving the object out and filling the gap with others, or by
    putting it in and leaving out those that it makes superfluous. The log odds are those of the object being
    there: the log density of the scene with it less that of the scene without.

    Objects of one shape do not stand for each other: that one of them is there and not another by name would
    halve the odds of both. `copies` (N, N) tells which are alike, each one like itself.
    """
    density = log_density_of_choice(layers, choice)

    def rival(one: jax.Array) -> tuple[jax.Array, jax.Array]:
        absent = choice[one] == no_object(layers)
        scene = jax.lax.cond(
            absent,
            lambda: _replaced(layers, choice, one, copies[one]),
            lambda: filled(layers, choice.at[one].set(no_object(layers)), copies[one]),
        )
        gain = log_density_of_choice(layers, scene) - density
        return scene, jnp.where(absent, gain, -gain)

    return jax.lax.map(rival, jnp.arange(len(choice)))


@jax.jit
def filled(layers: PoseLayers, choice: jax.Array, banned: jax.Array) -> jax.Array:
    """The scene (N,) with objects added that are not `banned` (N,): what gains most first, while any does."""
    objects = jnp.arange(len(choice))

    def gains(choice: jax.Array) -> tuple[jax.Array, jax.Array]:
        front = nearest_layer(layers, choice, objects >= 0)

        def best(one: jax.Array) -> tuple[jax.Array, jax.Array]:
            gain = gain_before(layers, front, one) + layers.rests.given(choice, one)
            gain = gain.at[no_object(layers)].set(-jnp.inf)  # rounding is no object
            return jnp.argmax(gain), jnp.max(gain)

        poses, gain = jax.lax.map(best, objects)
        gain = gain - jnp.sum(layers.rests.of(choice))
        return poses, jnp.where(banned | (choice != no_object(layers)), -jnp.inf, gain)

    def add(state: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        choice, poses, gain = state
        one = jnp.argmax(gain)
        choice = choice.at[one].set(poses[one])
        return choice, *gains(choice)

    start = choice, *gains(choice)
    return jax.lax.while_loop(lambda state: jnp.max(state[2]) > 0, add, start)[0]


def _without_any(layers: PoseLayers, choice: jax.Array) -> jax.Array:
    """The scene, or a better one in which others stand for an object, one object after the other."""

    def leave_out(choice: jax.Array, one: jax.Array) -> tuple[jax.Array, None]:
        def without() -> jax.Array:
            others = filled(layers, choice.at[one].set(absent), objects == one)
            return _better(layers, choice, others)

        return jax.lax.cond(choice[one] == absent, lambda: choice, without), None

    absent, objects = no_object(layers), jnp.arange(len(choice))
    return jax.lax.scan(leave_out, choice, objects)[0]


def _with_replacements(layers: PoseLayers, choice: jax.Array) -> jax.Array:
    """The scene, or a better one in which an object stands for others, one object after the other."""

    def put(choice: jax.Array, one: jax.Array) -> tuple[jax.Array, None]:
        return _better(layers, choice, _replaced(layers, choice, one, objects == one)), None

    objects = jnp.arange(len(choice))
    return jax.lax.scan(put, choice, objects)[0]


def _replaced(layers: PoseLayers, choice: jax.Array, one: jax.Array, kept: jax.Array) -> jax.Array:
    """The best scene with the object in one of its poses, without those that are then superfluous.

    Those that are `kept` (N,), itself among them, stay.

    The poses that are tried are the best one beside all others, and the best ones if they were granted every
    pixel that they explain, whether or not others explain it too.
    """
    front_m, density = front = nearest_layer(layers, choice, jnp.arange(len(choice)) != one)
    covers = layers.depth_m[one] < layers.rest_m[None]
    explained = jnp.where(covers, layers.log_density[one] - layers.rest_log_density[None], 0.0)
    spoilt = jnp.where(layers.depth_m[one] < front_m[None], layers.log_density[one] - density[None], 0.0)
    gain = jnp.sum(jnp.where(explained > 0, explained, jnp.minimum(spoilt, 0.0)), axis=1)
    gain = (gain + layers.log_alone[one]).at[no_object(layers)].set(-jnp.inf)
    _, poses = jax.lax.top_k(gain, min(REPLACING, len(gain) - 1))
    beside = gain_before(layers, front, one) + layers.rests.given(choice, one)
    poses = jnp.append(poses, jnp.argmax(beside.at[no_object(layers)].set(-jnp.inf)))

    density_of = partial(log_density_of_choice, layers)

    def leave_out(
        scene: tuple[jax.Array, jax.Array], other: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], None]:
        def without() -> tuple[jax.Array, jax.Array]:
            fewer = scene[0].at[other].set(no_object(layers))
            density = density_of(fewer)
            better = density > scene[1]
            return jnp.where(better, fewer, scene[0]), jnp.where(better, density, scene[1])

        stays = kept[other] | (scene[0][other] == no_object(layers))
        return jax.lax.cond(stays, lambda: scene, without), None

    def put(pose: jax.Array) -> tuple[jax.Array, jax.Array]:
        scene = choice.at[one].set(pose)
        return jax.lax.scan(leave_out, (scene, density_of(scene)), jnp.arange(len(choice)))[0]

    scenes, densities = jax.lax.map(put, poses)
    return scenes[jnp.argmax(densities)]


def _better(layers: PoseLayers, choice: jax.Array, other: jax.Array) -> jax.Array:
    better = log_density_of_choice(layers, other) > log_density_of_choice(layers, choice)
    return jnp.where(better, other, choice)
