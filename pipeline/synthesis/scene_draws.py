"""Scene graphs and poses drawn from the prior of supplement O."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from scene.model.prior import (
    CHILD_FACES,
    POSE_UNIFORMS,
    PosePrior,
    sample_pose,
    supporting_face_probabilities,
)
from scene.model.scene_graph import ROOT, Bodies, SceneGraph


def drawn_parents(
    rng: np.random.Generator, free: int, supports: int, floating_weight: float
) -> NDArray[np.int32]:
    """Parents (free + supports,) of a tree of `WeightedTrees` over so many objects and what carries them.

    Parents are drawn one by one, each floating with its weight, until they make no circle: trees are then as
    likely as their weights say.
    """
    bodies = free + supports
    weights = np.concatenate([[floating_weight], np.ones(bodies)])
    while True:
        parents = np.full(bodies, ROOT, np.int32)
        parents[:free] = rng.choice(bodies + 1, free, p=weights / weights.sum()) - 1
        reached = parents
        for _ in range(free):
            reached = np.where(reached == ROOT, ROOT, parents[reached])
        if (reached == ROOT).all():
            return parents


def drawn_scene(
    rng: np.random.Generator,
    prior: PosePrior,
    bodies: Bodies,
    slabs: NDArray[np.float64],
    floating_weight: float,
) -> SceneGraph:
    """A graph, and poses of the objects under it; what does not move is last, at poses (S, 7)."""
    count = len(bodies.movable)
    free = count - len(slabs)
    parents = drawn_parents(rng, free, len(slabs), floating_weight)
    poses = np.concatenate([np.tile([1.0, 0, 0, 0, 0, 0, 0], (free, 1)), slabs])
    faces = np.zeros((2, count), np.int32)
    placed = np.arange(count) >= free

    def scene() -> SceneGraph:
        return SceneGraph(*map(jnp.asarray, (parents, *faces, poses, np.ones(count, bool))))

    while not placed.all():
        one = int(np.flatnonzero(~placed & ((parents == ROOT) | placed[parents]))[0])
        on = parents[one]
        if on != ROOT:
            carrying = bodies.supporting_faces[on]
            shares = np.asarray(
                supporting_face_probabilities(prior, carrying, jnp.asarray(poses[on])), np.float64
            )
            faces[:, one] = rng.integers(CHILD_FACES), rng.choice(len(shares), p=shares / shares.sum())
        poses[one] = _sampled(
            jnp.asarray(rng.random(POSE_UNIFORMS)), prior, bodies, scene(), jnp.asarray(one)
        )
        placed[one] = True
    return scene()


_sampled = jax.jit(sample_pose)
