"""States of voxels given many rays, by expectation propagation with one categorical site per (ray, voxel).

The noisy forward model of one ray (docs/model.md, section I): it ends at the first voxel that stops it,

    p(z | O) = s_before(z) + sum_i [prod_(j<i) (1 - o_j)] o_i s(z | z_i) + [prod_j (1 - o_j)] s_miss(z),

where s_before is 0 unless the ray is a part of one, and o is the opacity of a voxel's state for rays that
come from its one side or the other: 1 if it is occupied, 0 if it is empty; further states hold some surface
although their centre is free. One ray is exact by a forward and a backward recursion; crossing rays are not,
and sites are refined in damped parallel sweeps (Minka 2001).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

TINY = 1e-30
"""Numerical guard above float32's least number."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SensorRays:
    """R rays, each through at most L voxels, nearest first.

    Attributes:
        voxel: (R, L) int32 index of each voxel; the number of voxels V fills what is left.
        association: (R, L) probability that the ray passes the voxel at all; 1 for an exact ray.
        density: (R, L) s(z | z_i) of the measured depth if the ray ends there.
        before: (R,) density of the measured depth times the probability that the ray ended before its first
            voxel; 0 for a whole ray.
        miss: (R,) s_miss(z) if it ends at none of them. Densities, before and miss share any factor per ray.
        side: (R, L) int32, from which side the ray comes to each voxel: a row of the opacities.
    """

    voxel: jax.Array
    association: jax.Array
    density: jax.Array
    before: jax.Array
    miss: jax.Array
    side: jax.Array


class VoxelStates(NamedTuple):
    """Marginals after the last sweep.

    Attributes:
        probability: (V, C) of each state.
        reach: (V,) largest posterior probability, over the rays, that one came as far as the voxel.
    """

    probability: jax.Array
    reach: jax.Array


@partial(jax.jit, static_argnames="sweeps")
def voxel_states(
    rays: SensorRays, log_prior: jax.Array, opacity: jax.Array, *, sweeps: int = 60, damping: float = 0.2
) -> VoxelStates:
    """Approximate marginals of voxels that are independent a priori, given all rays.

    Args:
        rays: the measurements.
        log_prior: (V, C) log probability of each of C states, up to a constant per voxel.
        opacity: (S, C) probability that a ray which comes from that side to a voxel in that state ends there.
        sweeps: how often every site is refined.
        damping: share of the way that a site moves in one sweep.
    """
    count = len(log_prior)
    real = (rays.voxel < count)[..., None]
    padded = jnp.pad(log_prior, ((0, 1), (0, 0)))
    ends = rays.association[..., None] * opacity[rays.side]

    def beliefs(sites: jax.Array) -> jax.Array:
        return padded.at[rays.voxel].add(sites)

    def sweep(_: int, sites: jax.Array) -> jax.Array:
        cavity = jax.nn.softmax(beliefs(sites)[rays.voxel] - sites, axis=-1)
        ended, open_, beyond = _ray_messages(rays, (cavity * ends).sum(axis=-1))
        here = ends * rays.density[..., None] + (1 - ends) * beyond[..., None]
        refined = jnp.log(ended[..., None] + open_[..., None] * here + TINY)
        refined -= jnp.log(ended + open_ * beyond + TINY)[..., None]
        return sites + damping * jnp.where(real, refined - sites, 0.0)

    sites = jax.lax.fori_loop(0, sweeps, sweep, jnp.zeros(ends.shape, log_prior.dtype))
    total = beliefs(sites)
    cavity = jax.nn.softmax(total[rays.voxel] - sites, axis=-1)
    reached = jnp.where(real[..., 0], _came_as_far(rays, (cavity * ends).sum(axis=-1)), 0.0)
    reach = jnp.zeros(count + 1, log_prior.dtype).at[rays.voxel].max(reached)
    return VoxelStates(jax.nn.softmax(total[:count], axis=-1), reach[:count])


def _ray_messages(rays: SensorRays, ends: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """For every place of every ray, with the probabilities (R, L) that it ends there if it comes there.

    Returns:
        Weight of having ended before it, probability of not having ended before it, and density of the
        measurement given that the ray goes beyond it; each (R, L).
    """

    def forward(carry: tuple, at: tuple) -> tuple:
        open_, ended = carry
        end, density = at
        return (open_ * (1 - end), ended + open_ * end * density), (open_, ended)

    def backward(beyond: jax.Array, at: tuple) -> tuple:
        end, density = at
        return end * density + (1 - end) * beyond, beyond

    start = jnp.ones_like(rays.miss), rays.before
    places = ends.T, rays.density.T
    _, (open_, ended) = jax.lax.scan(forward, start, places)
    _, beyond = jax.lax.scan(backward, rays.miss, places, reverse=True)
    return ended.T, open_.T, beyond.T


def _came_as_far(rays: SensorRays, ends: jax.Array) -> jax.Array:
    """Posterior probability (R, L) that the ray passes the voxel and did not end before it."""
    ended, open_, beyond = _ray_messages(rays, ends)
    on = open_ * (ends * rays.density + (1 - ends) * beyond)
    return rays.association * on / (ended + on + TINY)
