"""A cheap score of hypotheses for proposals: the object's distance field at the observed points.

Not a density: delayed acceptance lets the exact likelihood decide.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from scene.execution import score_on_all_cores
from shapes.rendering.distance_field import squared_distance
from shapes.rendering.object_library import ObjectLibrary
from shapes.rendering.ray_casting import PosedObjects

BATCH = 256
"""Hypotheses scored together: with a thousand points their coordinates stay in the cache."""


def distance_score(
    library: ObjectLibrary, posed: PosedObjects, points_m: ArrayLike, scale_m: float
) -> NDArray[np.float32]:
    """Mean over the points of max(0, 1 - (distance / scale)^2), (N,) in [0, 1].

    Args:
        library: the objects.
        posed: N hypotheses.
        points_m: (I, P, 3) observed points in the frame of each camera; z <= 0, or what is not finite, for
            padding.
        scale_m: distance from the surface at which a point no longer speaks for a hypothesis.
    """
    points_m = jnp.asarray(points_m, jnp.float32)
    return score_on_all_cores(lambda posed: _nearness(library, posed, points_m, scale_m), posed)


@jax.jit
def _nearness(
    library: ObjectLibrary, posed: PosedObjects, points_m: jax.Array, scale_m: jax.Array | float
) -> jax.Array:
    """The same in one kernel."""
    known = (points_m[..., 2] > 0) & jnp.isfinite(points_m).all(axis=-1)
    points_m = jnp.where(known[None], jnp.moveaxis(points_m, -1, 0), 0.0)
    points_known = known.sum(axis=1)
    count = len(posed)
    batches = -(-count // BATCH)
    batch = min(BATCH, count)
    missing = batches * batch - count
    posed = jax.tree.map(lambda leaf: jnp.pad(leaf, [(0, missing)] + [(0, 0)] * (leaf.ndim - 1)), posed)
    posed = jax.tree.map(lambda leaf: leaf.reshape(batches, batch, *leaf.shape[1:]), posed)

    def score(posed: PosedObjects) -> jax.Array:
        square = squared_distance(library, posed, points_m[:, posed.camera_index])
        near = jnp.maximum(1.0 - square / jnp.asarray(scale_m, jnp.float32) ** 2, 0.0)
        near = jnp.where(known[posed.camera_index], near, 0.0).sum(axis=1)
        return near / jnp.maximum(points_known[posed.camera_index], 1).astype(jnp.float32)

    return jax.lax.map(score, posed).reshape(-1)[:count]
