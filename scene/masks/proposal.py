"""Poses at which masks of a shape score most, and their Boltzmann weights.

An atom is an orientation and a cell. Its probability is in proportion to exp(beta score), with beta from a
given effective number of atoms, for it to mean the same for all shapes. Spread over its cell and over the
turns between neighbouring orientations, an atom becomes a component of a density of poses
(`scene.mcmc.mixture_init`), so that every pose near it has a density to come back with.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_softmax, softmax

from scene.masks.convolution import FlatGrid, best_places, scores_in
from scene.masks.grid import EvidenceGrid, SeenSpace, seen_space
from scene.masks.shape_masks import Detector, detector, is_thin
from scene.objects.scene_object import SceneObject
from scene.observation.frame_data import SceneData
from shapes.geometry.poses import poses_of

PAIRS = 2000
"""Of orientation and coarse cell that are looked at in fine cells, which takes a tenth of the time."""

EFFECTIVE_ATOMS = 16.0
"""Half of those that chains are offered."""

COLDEST = 1e4
"""Largest beta: scores that differ by a thousandth then differ by a factor of 20,000."""

SAME_PIXELS = 0.9
"""Overlap of the pixels of two rounds of the search from which on masks are not laid on them again: ICP on
the new pixels corrects what atoms of the old ones are off. Speed: a third of a search for 21 shapes."""

BISECTIONS = 40
"""Beta to a hundred-millionth."""

_CHILDREN = np.stack(np.meshgrid(*3 * [np.arange(-1, 3)], indexing="ij"), axis=-1).reshape(-1, 3)
"""Fine cells of a coarse one, and those round them."""

_log = logging.getLogger("voxscene.masks")


@dataclass(frozen=True, kw_only=True, eq=False)
class Atoms:
    """Poses of high score, the highest first.

    Attributes:
        poses: (n, 7) float32 camera_from_box, the box's centre in the middle of a cell.
        scores: (n,) between -1 and 1: mean evidence of surface cells, less that of those to be free.
    """

    poses: NDArray[np.float32]
    scores: NDArray[np.float32]

    @classmethod
    def none(cls) -> Atoms:
        """Where there is nothing to find."""
        return cls(poses=np.zeros((0, 7), np.float32), scores=np.zeros(0, np.float32))


@dataclass(frozen=True, kw_only=True, eq=False)
class MaskSearch:
    """Detectors of objects, and what a camera saw.

    Attributes:
        seen: the frame's grid; None where there is no foreground.
        detectors: of each object, None of those that are too thin for the grid's cells.
    """

    seen: SeenSpace | None
    detectors: Sequence[Detector | None]
    _last_atoms: dict[int, tuple[NDArray[np.bool_], Atoms]] = field(default_factory=dict, init=False)
    """Of objects that were sought, and the pixels (H, W) on which they were."""

    @classmethod
    def of(cls, data: SceneData, objects: Sequence[SceneObject]) -> MaskSearch:
        """The search in one frame."""
        seen = seen_space(data, max(float(np.linalg.norm(one.half_extents_m)) for one in objects))
        detectors = [_detector_for(one, seen, standing=data.table is not None) for one in objects]
        return cls(seen=seen, detectors=detectors)

    def atoms(self, one: int, unexplained: NDArray[np.bool_]) -> Atoms:
        """The best poses of an object on pixels (H, W) of the foreground that may show it.

        On nearly the same pixels they are those that were found before.
        """
        shape = self.detectors[one]
        if self.seen is None or shape is None:
            return Atoms.none()
        before = self._last_atoms.get(one)
        if before is not None and _overlap(before[0], unexplained) >= SAME_PIXELS:
            return before[1]
        atoms = best_atoms(self.seen.waiting(unexplained), shape)
        self._last_atoms[one] = unexplained, atoms
        return atoms


def _overlap(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    """Pixels of both masks (H, W) over those of any; 1 where both are empty."""
    either = np.count_nonzero(one | other)
    return np.count_nonzero(one & other) / either if either else 1.0


def _detector_for(one: SceneObject, seen: SeenSpace | None, *, standing: bool) -> Detector | None:
    if seen is None:
        return None
    if is_thin(one, seen.pitch_m):
        _log.warning("%s is too thin for masks of %.0f mm cells", one.name, 1000 * seen.pitch_m)
        return None
    return detector(one, seen.pitch_m, standing=standing)


def best_atoms(grid: EvidenceGrid, shape: Detector) -> Atoms:
    """The best cells of all orientations: found in coarse cells, told apart in fine ones."""
    coarse = best_places(grid.coarser(), shape.coarse, PAIRS)
    turns, inner = coarse.turns, 2 * coarse.cells[:, None] + _CHILDREN
    if not len(turns):
        return Atoms.none()
    scores = scores_in(FlatGrid.of(grid.evidence, shape.fine.reach), shape.fine, turns, inner)
    best = scores.argmax(axis=1)
    cells, scores = inner[np.arange(len(best)), best], scores[np.arange(len(best)), best]
    order = np.argsort(-scores, kind="stable")
    poses = np.tile(grid.camera_from_grid, (len(order), 1, 1))
    poses[:, :3, 3] += grid.pitch_m * (cells[order] + 0.5) @ grid.camera_from_grid[:3, :3].T
    poses[:, :3, :3] = poses[:, :3, :3] @ shape.fine.rotations[turns[order]]
    return Atoms(poses=poses_of(poses).astype(np.float32).reshape(-1, 7), scores=scores[order])


def log_boltzmann(scores: NDArray[np.floating], effective: float = EFFECTIVE_ATOMS) -> NDArray[np.float64]:
    """Log probabilities (n,) in proportion to exp(beta score), with 1 / sum p^2 = `effective`.

    Beta lies between 0, where there are fewer atoms, and COLDEST, where more of them score alike.
    """
    scores = np.asarray(scores, np.float64)
    low, high = 0.0, COLDEST
    for _ in range(BISECTIONS):
        beta = (low + high) / 2
        atoms = 1 / np.square(softmax(beta * scores)).sum()
        low, high = (beta, high) if atoms > effective else (low, beta)
    return log_softmax(low * scores)
