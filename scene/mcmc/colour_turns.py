"""Turns of objects that depth cannot tell, drawn from what their colours say.

A can's spin, or which way round a box lies: shape and depth are the same after each of these turns, so that
given everything else of a sample they are independent of the depth images, and a draw from their conditional
is a Gibbs step on the posterior with colours, which the chains have as their target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from scene.execution import FAST_COMPILE
from scene.likelihood.colour_layers import ColourLayers
from scene.likelihood.object_renderer import ObjectRenderer
from scene.mcmc.face_relabelling import placed
from scene.mcmc.sampling import Samples
from scene.model.scene_graph import SceneGraph
from scene.objects.scene_object import SceneObject
from scene.objects.surface_colour import SPINS
from scene.objects.symmetry import turns_about
from scene.observation.frame_data import SceneData
from shapes.geometry.poses import matrices_of, poses_of

FINER = 5
"""Steps of three degrees in each of a spin's: between them the angle is drawn evenly."""
SAME_M, SAME_RAD = 0.02, 0.5
"""Samples that differ by more from the pose in which colours were compared, turns apart, keep their turn;
as modes of a summary."""


@dataclass(frozen=True, eq=False)
class SeenColours:
    """The best scene in the frame whose colours tell.

    Attributes:
        data: the frame.
        colours: of the frame and of all objects.
        renderer: of all N objects.
        objects: these.
        numbers: (F,) which of them are found.
        poses: (F, 7) camera_from_box of these.
        weight: exponent of the colours' factor in what the chains sample.
    """

    data: SceneData
    colours: ColourLayers
    renderer: ObjectRenderer
    objects: Sequence[SceneObject]
    numbers: NDArray[np.integer]
    poses: NDArray[np.floating]
    weight: float

    def log_factors(self) -> NDArray[np.float64]:
        """What the colours of each found object (F,) add to the log density of the image."""
        layers_m = self.renderer.layers(self.numbers, self.poses, self.data.window)
        factors = self.colours.log_factors(self.numbers, self.poses, layers_m)
        return np.asarray(factors, np.float64).sum(axis=(1, 2))

    def log_shares(self, found: int, turns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log probabilities (T,) of turns of one of the found objects, each as likely before."""
        number, pose = self.numbers[found : found + 1], self.poses[found : found + 1]
        layer_m = self.renderer.layers(number, pose, self.data.window)[0]
        sums = self.weight * self.colours.log_factors_of_turns(int(number[0]), turns, pose[0], layer_m)
        return sums - np.logaddexp.reduce(sums)


def with_drawn_turns(
    rng: np.random.Generator, seen: SeenColours, world_from_camera: NDArray[np.float64], samples: Samples
) -> Samples:
    """The samples with such turns drawn anew.

    Args:
        rng: random numbers.
        seen: the best scene, whose objects are in the samples' first slots.
        world_from_camera: (4, 4) of its frame.
        samples: of chains.
    """
    for slot, number in enumerate(seen.numbers.tolist()):
        one = seen.objects[number]
        if len(turns := turns_of(one)) == 1 or one.colour is None or not one.colour.exact:
            continue
        log_shares = seen.log_shares(slot, turns)
        here = matrices_of(samples.poses[..., slot, :])
        best = world_from_camera @ matrices_of(np.asarray(seen.poses[slot], np.float64))
        before, same = _turns_taken(best, here, turns)
        drawn = rng.choice(len(log_shares), p=np.exp(log_shares), size=before.shape)
        after = here @ np.linalg.inv(turns)[before] @ turns[drawn]
        if one.colour.spins:
            after = after @ _between(rng, one, before.shape)
        poses = samples.poses.copy()
        poses[..., slot, :] = np.where(same[..., None], poses_of(after), poses[..., slot, :])
        gained = np.where(same, log_shares[drawn] - log_shares[before], 0.0)
        samples = _with_faces(samples, slot, poses[..., slot, :])
        samples = replace(samples, poses=poses, log_posterior=samples.log_posterior + gained)
    return samples


def _with_faces(samples: Samples, slot: int, poses: NDArray[np.float64]) -> Samples:
    """The samples with the names of an object's faces at poses (S, chains, 7): what touches does so still."""
    leaves = samples.parents, samples.child_faces, samples.parent_faces, samples.poses
    scenes = SceneGraph(*map(jnp.asarray, leaves), present=jnp.ones(samples.parents.shape, bool))
    own, others = _renamed_faces(scenes, jnp.int32(slot), jnp.asarray(poses))
    return replace(samples, child_faces=np.asarray(own), parent_faces=np.asarray(others))


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _renamed_faces(scenes: SceneGraph, chosen: jax.Array, poses: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Own and parents' faces (S, chains, C) of scenes with one object at other poses (S, chains, 7)."""

    def one(scene: SceneGraph, pose: jax.Array) -> tuple[jax.Array, jax.Array]:
        there = placed(scene, chosen, pose)
        return there.child_faces, there.parent_faces

    return jax.vmap(jax.vmap(one))(scenes, poses)


def turns_of(one: SceneObject) -> NDArray[np.float64]:
    """All turns (T, 4, 4) that leave an object's shape as it is, spins in finer steps.

    None but the identity where its colours look the same after all of them.
    """
    if one.colour is None or len(one.colour.looks) == 1:
        return np.eye(4)[None]
    if not one.colour.spins:
        return one.colour.turns
    steps = 2 * np.pi / (SPINS * FINER) * np.arange(FINER)
    return (one.colour.turns[:, None] @ turns_about(one.spin_line, steps)).reshape(-1, 4, 4)


def _between(rng: np.random.Generator, one: SceneObject, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Turns (..., 4, 4) by angles within a step."""
    half = np.pi / (SPINS * FINER)
    return turns_about(one.spin_line, rng.uniform(-half, half, int(np.prod(shape)))).reshape(*shape, 4, 4)


def _turns_taken(
    best: NDArray[np.float64], poses: NDArray[np.float64], turns: NDArray[np.float64]
) -> tuple[NDArray[np.int_], NDArray[np.bool_]]:
    """Which turn (...) poses (..., 4, 4) have taken from the best, and whether they are no further away."""
    apart = np.linalg.inv(best) @ poses
    traces = np.einsum("...ij,tij->...t", apart[..., :3, :3], turns[:, :3, :3])
    taken = traces.argmax(axis=-1)
    angle = np.arccos(np.clip((traces.max(axis=-1) - 1) / 2, -1, 1))
    left = apart @ np.linalg.inv(turns)[taken]
    return taken, (angle < SAME_RAD) & (np.linalg.norm(left[..., :3, 3], axis=-1) < SAME_M)
