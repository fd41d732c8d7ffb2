"""A cheap score of hypotheses for proposals: the object's distance field at the observed points.

Not a density: delayed acceptance lets the exact likelihood decide.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from shapes.object_library import ObjectLibrary
from shapes.ray_casting import PosedObjects, signed_distance_m

BATCH = 256
"""Hypotheses scored together."""


@jax.jit
def distance_score(
    library: ObjectLibrary, posed: PosedObjects, points_m: jax.Array, scale_m: jax.Array | float
) -> jax.Array:
    """Mean over the points of max(0, 1 - (distance / scale)^2), (N,) in [0, 1].

    Args:
        library: the objects.
        posed: N hypotheses.
        points_m: (I, P, 3) observed points in the frame of each camera; z <= 0 for padding.
        scale_m: distance from the surface at which a point no longer speaks for a hypothesis.
    """

    def one(hypothesis: PosedObjects) -> jax.Array:
        points = points_m[hypothesis.camera_index].T
        rotation, translation = hypothesis.camera_from_object[:3, :3], hypothesis.camera_from_object[:3, 3]
        offset = [points[axis] - translation[axis] for axis in range(3)]
        local = [sum(rotation[b, a] * offset[b] for b in range(3)) for a in range(3)]
        distance = signed_distance_m(library, hypothesis.object_index, local)
        near = jnp.maximum(1.0 - (distance / scale_m) ** 2, 0.0)
        return jnp.where(points[2] > 0, near, 0.0).sum() / jnp.maximum((points[2] > 0).sum(), 1)

    return jax.lax.map(one, posed, batch_size=BATCH)
