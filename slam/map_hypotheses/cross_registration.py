"""Cross-registration of keyframes: each against the map of chosen others, locally or globally.

Keyframes whose inlier ratio against the map of all others stays low are inconsistent. They are removed one by
one and registered again, globally, the one of highest inlier ratio first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from shapes.geometry import pose_sets
from shapes.geometry.poses import matrices_of, poses_of, single_precision_poses
from slam.keyframes.depth_view import CanvasView
from slam.keyframes.keyframe_map import KeyframeMap
from slam.registration.global_search import BATCH, log_scores_of_maps
from slam.registration.registered import CONVINCING_COVERED, Registration
from slam.registration.search import Searcher


@dataclass(frozen=True)
class KeyframeRegistrar:
    """The keyframes, each of which is seen through the eyes of others.

    Attributes:
        keyframe_map: all.
        noise: the sensor.
        compared: keyframes that one is compared with at once.
    """

    keyframe_map: KeyframeMap
    noise: DepthNoise
    compared: int

    def __len__(self) -> int:
        return len(self.keyframe_map)

    def register_locally(self, poses: NDArray[np.float64], index: int, others: Sequence[int]) -> Registration:
        """A keyframe where `poses` (N, 4, 4) have it, in the map of `others`."""
        searcher = self._searcher(poses, index, others)
        return searcher.at(poses_of(poses[index]).astype(np.float32))

    def register_globally(
        self, poses: NDArray[np.float64], index: int, others: Sequence[int]
    ) -> list[Registration]:
        """Plausible places of a keyframe anywhere in the map of `others`, the best first."""
        searcher = self._searcher(poses, index, others)
        nearest = min(others, key=lambda other: abs(other - index))
        found = searcher.anywhere(poses_of(poses[nearest]).astype(np.float32))
        return [located for located in found if located.is_plausible]

    def log_composite(self, poses: NDArray[np.float64]) -> float:
        """Half the log densities of all images, each given all the others, next to `poses`.

        A composite likelihood (Besag 1975); half, for each overlap counts from both sides. By the chain rule
        the first images are given little, and wrong places win by how the unknown is foreseen: of five views
        round an object, some turned by 18 and 42 degrees beat the true ones by 57 nats, and by 32 and 32
        degrees by 285; given all the others the true ones win, by 55 and 188 (docs/model.md, development
        films).
        """
        return 0.5 * sum(one.log_density for one in self._register_all(poses))

    def log_composite_of_blocks(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """The same (N, B), by blocks of pixels of each image, whose errors are about independent."""
        return 0.5 * np.stack([one.log_density_of_blocks(self.noise) for one in self._register_all(poses)])

    def log_scores(
        self, poses: NDArray[np.float64], judged: Sequence[int], blur: float
    ) -> NDArray[np.float64]:
        """Sums (C,) of approximate log densities of images, each in the map of all others.

        Args:
            poses: (C, N, 4, 4) where maps have the keyframes.
            judged: keyframes whose images count.
            blur: of surfaces, relative to depth.
        """
        total, placed = np.zeros(len(poses)), pose_sets.pad_to_multiple(poses, BATCH)
        everything = self.keyframe_map.stacked(np.arange(len(self)))
        for index in judged:
            others = np.arange(len(self)) != index
            relative = single_precision_poses(np.linalg.inv(placed[:, [index]]) @ placed)
            seen = self.view(index), self.noise, blur
            for first in range(0, len(poses), BATCH):
                scores = log_scores_of_maps(everything, others, relative[first : first + BATCH], *seen)
                total[first : first + BATCH] += np.asarray(scores, np.float64)[: len(total) - first]
        return total

    def view(self, index: int) -> CanvasView:
        """A keyframe's image."""
        return self.keyframe_map.surface(index).view

    def all_but(self, index: int) -> list[int]:
        """The other keyframes."""
        return [other for other in range(len(self)) if other != index]

    def _register_all(self, poses: NDArray[np.float64]) -> list[Registration]:
        """Each keyframe where `poses` have it, in the map of all others."""
        return [self.register_locally(poses, index, self.all_but(index)) for index in range(len(self))]

    def _searcher(self, poses: NDArray[np.float64], index: int, others: Sequence[int]) -> Searcher:
        placed = poses_of(poses[list(others)]).astype(np.float32)
        rest = self.keyframe_map.only(others)
        return Searcher(rest, placed, self.view(index), self.noise, self.compared)


def inlier_ratio(located: Registration) -> float:
    """Share of the returns that meet the map and lie on it; zero where hardly any meets it."""
    return located.explained / located.covered if located.covered >= CONVINCING_COVERED else 0.0


CONSISTENT_INLIER_RATIO = 0.9
"""Share of the returns that meet the map and lie on it, from which on a keyframe is consistent: at true poses
round objects it was .92 at least, at wrong ones .6 to .9 (docs/model.md, development films)."""


def register_inconsistent(
    registrar: KeyframeRegistrar, poses: NDArray[np.float64], core: list[int]
) -> NDArray[np.float64]:
    """Poses (N, 4, 4) with those that are not of the `core` sought in its map."""
    poses = poses.copy()
    missing = [index for index in range(len(registrar)) if index not in core]
    while missing:
        found = {
            index: next(iter(registrar.register_globally(poses, index, core)), None) for index in missing
        }
        sure = [
            index
            for index in missing
            if (place := found[index]) and inlier_ratio(place) >= CONSISTENT_INLIER_RATIO
        ]
        most = max(missing, key=lambda index: place.explained if (place := found[index]) else -1.0)
        for index in sure or [most]:
            if place := found[index]:
                poses[index] = matrices_of(place.optimum.pose)
            core, missing = sorted([*core, index]), [other for other in missing if other != index]
    return np.linalg.inv(poses[0]) @ poses


def consistent_set(registrar: KeyframeRegistrar, poses: NDArray[np.float64]) -> list[int]:
    """Keyframes that do not contradict each other: those that do most are left out, one by one."""
    core = list(range(len(registrar)))
    while len(core) > 2:
        agreements = [
            inlier_ratio(
                registrar.register_locally(poses, index, [other for other in core if other != index])
            )
            for index in core
        ]
        worst = int(np.argmin(agreements))
        if agreements[worst] >= CONSISTENT_INLIER_RATIO:
            break
        del core[worst]
    return core
