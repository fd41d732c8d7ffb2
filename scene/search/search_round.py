"""One round of the search: hypotheses of poses for unexplained pixels, then the best scene over all of them.

Hypotheses come from observed points and from DBSCAN clusters of points that the scene without the object
leaves unexplained, in resting, cube and spread orientations, refined by ICP. Whole scenes are annealed over
the pools of hypotheses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from scene.execution import map_parallel
from scene.masks.grid import cell_numbers
from scene.masks.proposal import Atoms, MaskSearch, log_boltzmann
from scene.objects.orientations import tried_rotations
from scene.objects.slots import OUT_OF_SIGHT
from scene.observation.detection import clusters
from scene.search.assignment import PoseLayers, choose, log_conditional
from scene.search.competing_scenes import best_of
from scene.search.hypotheses import PosePools
from scene.search.search_result import BoltzmannAtoms
from scene.search.template_matching import CANDIDATES, best_distinct, match_templates
from shapes.geometry.poses import matrices_of

FROM_MASKS = {"points": 0, "masks": CANDIDATES, "both": CANDIDATES // 2}
"""Of the poses that are refined."""

ATOMS = 32
"""Of an object, that chains are offered."""

ANCHORS, CENTRES = 192, 8
"""Points on which visible ones of an object are put, and places for its middle. Search effort."""

ANCHOR_SPACING_M = 0.012
"""Edge of the cells of which each has one anchor at most."""

CLUSTER_SCALES_M = (0.01, 0.02, 0.04)
"""Of neighbourhoods: close things come apart at the least, sparse ones hang together at the greatest."""

FEWEST_PIXELS = 10
"""Of a mask; else an object is sought on the whole foreground."""

HOT, COLD, SWEEPS = 150.0, 2.0, 12
"""First and last temperature of annealing, in nats, and its sweeps. Search effort."""

PARTICLES, GROUPS = 4, 2
"""Annealed together, and how many groups of them."""


@dataclass(frozen=True, eq=False)
class SearchRound:
    """A round of the search: hypotheses for what is unexplained, then the best scene over all pools.

    Attributes:
        rotations: of each object, camera_from_box (O, 3, 3) to be tried.
        by_masks: a second source of poses; None where the configuration asks for none.
        rng: random numbers of points and places.
    """

    rotations: Sequence[NDArray[np.float32]]
    by_masks: MaskSearch | None
    rng: np.random.Generator

    @classmethod
    def of(cls, pools: PosePools, rng: np.random.Generator) -> SearchRound:
        """The round for the pools' objects, in resting orientations first where there is a table."""
        table = pools.data.table
        camera_from_table = table and table.camera_from_table[:3, :3]
        rotations = [
            tried_rotations(one.rests if table else None, camera_from_table) for one in pools.objects
        ]
        second = FROM_MASKS[pools.config.proposals] > 0
        return cls(rotations, MaskSearch.of(pools.data, pools.objects) if second else None, rng)

    def __call__(
        self,
        key: jax.Array,
        pools: PosePools,
        scene: NDArray[np.integer],
        masks: Mapping[int, NDArray[np.bool_]],
        index: int,
    ) -> tuple[PosePools, NDArray[np.integer]]:
        """Pools with new poses of the objects that have a mask, and the best scene (N,).

        Args:
            key: random key.
            pools: of poses.
            scene: (N,) the best one so far.
            masks: (H, W) pixels that may show the object, by object.
            index: of the round, whose part of the pools is replaced.
        """
        sought, (refined, _) = list(masks), self.hypotheses(pools, masks)
        pools = pools.with_poses(pools.densest(refined, scene, sought), index * pools.config.pool, sought)
        return pools, best_of(pools, _annealed(key, pools.layers), scene)

    def hypotheses(
        self, pools: PosePools, masks: Mapping[int, NDArray[np.bool_]]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Poses of objects on the pixels of M masks, searched side by side on all cores.

        Refined ones (M, CANDIDATES, 7) and what they were before: from points and then from masks, the best
        of each first.
        """
        data = pools.data
        points = data.view.points_m.astype(np.float32)
        enough = {
            one: mask if mask.sum() >= FEWEST_PIXELS else data.foreground for one, mask in masks.items()
        }
        drawn = {one: _drawn(points[mask], self.rng) for one, mask in enough.items()}

        def find(index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
            one, view = pools.objects[index], replace(data.view, unexplained=masks[index])
            atoms = self.by_masks.atoms(index, enough[index]) if self.by_masks else Atoms.none()
            beside = atoms.poses[_apart(atoms, FROM_MASKS[pools.config.proposals])]
            places = _places(*drawn[index])
            return jax.device_get(
                match_templates(view, one.points_m, one.normals, self.rotations[index], *places, beside)
            )

        refined, candidates = zip(*map_parallel(find, masks), strict=True)
        return np.stack(refined), np.stack(candidates)

    def boltzmann_atoms(self, pools: PosePools, wanted: NDArray[np.bool_]) -> BoltzmannAtoms | None:
        """Atoms of the objects `wanted` (N,) on the whole foreground; None where no masks were asked for."""
        if self.by_masks is None or self.by_masks.seen is None:
            return None
        poses = np.tile(np.asarray(OUT_OF_SIGHT, np.float64), (len(pools.objects), ATOMS, 1))
        log_weights = np.full((len(pools.objects), ATOMS), -np.inf)
        masks, some = self.by_masks, np.flatnonzero(wanted).tolist()
        every = map_parallel(lambda index: masks.atoms(index, pools.data.foreground), some)
        for index, atoms in zip(some, every, strict=True):
            chosen = np.unique(_apart(atoms, ATOMS))
            if len(chosen):
                poses[index, : len(chosen)] = atoms.poses[chosen]
                log_weights[index, : len(chosen)] = log_boltzmann(atoms.scores[chosen])
        return BoltzmannAtoms(poses=poses, log_weights=log_weights, pitch_m=self.by_masks.seen.pitch_m)


def _apart(atoms: Atoms, count: int) -> NDArray[np.integer]:
    """Places of atoms of high score that differ, the best first; none where there are no atoms."""
    if not len(atoms.poses):
        return np.zeros(0, np.int32)
    rotations = matrices_of(atoms.poses)[:, :3, :3].astype(np.float32)
    return np.asarray(best_distinct(rotations, atoms.poses[:, 4:], atoms.scores, count))


def _annealed(key: jax.Array, layers: PoseLayers) -> NDArray[np.int32]:
    """The best scene (N,) of all particles, groups of which are annealed side by side."""

    def anneal(key: jax.Array) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        return jax.device_get(choose(key, layers, HOT, COLD, PARTICLES, SWEEPS))

    groups = map_parallel(anneal, jax.random.split(key, GROUPS))
    choices, log_densities = (np.concatenate(leaves) for leaves in zip(*groups, strict=True))
    return choices[np.argmax(log_densities)]


def _drawn(
    points_m: NDArray[np.float32], rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The points (M, 3) in random order, and as random ones (A, 3) spread over them."""
    points_m = points_m[rng.permutation(len(points_m))]
    one_a_cell = np.unique(cell_numbers(points_m, ANCHOR_SPACING_M), return_index=True)[1]
    return points_m, points_m[rng.permutation(one_a_cell)]


def _places(
    points_m: NDArray[np.float32], anchors_m: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Anchors (ANCHORS, 3) and centres (CENTRES, 3) of their clusters and of all the points they are from."""
    centres = clusters(anchors_m, CLUSTER_SCALES_M, fewest=3)
    centres = np.concatenate([centres, points_m.mean(axis=0)[None]])
    return np.resize(anchors_m, (ANCHORS, 3)), np.resize(centres, (CENTRES, 3)).astype(np.float32)


@jax.jit
def log_gains(layers: PoseLayers, chosen: jax.Array) -> jax.Array:
    """Log density (N, K) of the scene (N,) with each pose for the chosen one, less the scene's own."""
    conditionals = jax.vmap(lambda index: log_conditional(layers, chosen, index))(jnp.arange(len(chosen)))
    return conditionals - conditionals[jnp.arange(len(chosen)), chosen][:, None]
