"""The order of search for a camera in a map: near a prediction, then anywhere."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from recordings.types import DepthNoise
from shapes.geometry import pose_sets
from shapes.geometry.poses import matrices_of, single_precision_poses
from slam.keyframes.depth_view import CanvasView, central_depth, framing
from slam.keyframes.keyframe_map import KeyframeMap, place_distances, sample_points, selected_keyframes
from slam.registration import pose_grids
from slam.registration.global_search import ascend, log_map_scores
from slam.registration.local_map import LocalMap
from slam.registration.local_search import local_optimum, optimum_at
from slam.registration.registered import (
    PLAUSIBLE_COVERED,
    PLAUSIBLE_EXPLAINED,
    Registration,
    suppress_duplicates,
)

LEAST_EXPLAINED = PLAUSIBLE_EXPLAINED * PLAUSIBLE_COVERED
"""Places that look away from the map are foreseen as well as the right one, a centimetre beside it, fits."""

WIDE_KEYFRAMES = 8
"""Search effort."""

WIDE_PLACES = 5 * WIDE_KEYFRAMES
"""Search effort: of a large map those keyframes are searched that resemble the view most."""

WIDE_SHIFT_M, WIDE_ANGLE_RAD = 0.12, 0.15
"""Candidates closer than this climb to the same place."""

WIDE_BLUR, CLIMBED_BLUR = 0.06, 0.01
"""Relative to depth, as in `slam.registration.global_search`."""

SCORED_AT_ONCE = 256
"""Candidates: one size for which a kernel is compiled."""

WIDE_CLIMBED = 256
"""Candidates that climb: the grid is coarser than the modes, the right place may be the three hundredth on it
(measured)."""

CLIMBED_SHIFT_M, CLIMBED_ANGLE_RAD = 0.05, 0.05
"""Climbed candidates closer than this are one."""

WIDE_RENDERED = 24
"""Search effort."""

WIDE_REFINED = 6
"""Search effort."""

FAR_SHIFT_M, FAR_ANGLE_RAD = 0.08, 0.08
"""A refinement that ends farther from its start is begun again there."""

SETTLED_SHIFT_M, SETTLED_ANGLE_RAD = 0.003, 0.003
"""Half a pixel of the working image, at a metre: a rendering anew would show the same."""

LEAST_HELD = 0.1
"""Of a direction's precision, what a prediction may bring: along walls the noise of normals brings as much as
it does, and a camera that follows it slides."""

SETTLING = 2
"""Renderings by which an optimum next to the prediction is to settle: search effort."""

OUT_OF_SIGHT_M = 1000.0
"""Farther than any depth camera sees."""

REFINEMENTS = 3
"""Rounds of rendering anew and aligning again: while the optimum lies far from where it was rendered, and
while it rises where the start was a guess."""


@dataclass(frozen=True)
class Searcher:
    """One frame, and what it is searched in.

    Attributes:
        keyframe_map: the surfaces.
        keyframe_poses: (N, 7) where they are.
        view: the frame.
        noise: the sensor.
        compared: M, keyframes compared with at once.
    """

    keyframe_map: KeyframeMap
    keyframe_poses: NDArray[np.float32]
    view: CanvasView
    noise: DepthNoise
    compared: int

    def among(self, chosen: NDArray[np.bool_]) -> Searcher:
        """The same in a map of those keyframes (N,) alone that are chosen."""
        placed = self.keyframe_poses.copy()
        placed[~chosen, 4:] += OUT_OF_SIGHT_M
        return replace(self, keyframe_poses=placed)

    def near(self, starts: Sequence[ArrayLike], hold: float = 0.0) -> Registration:
        """The best optimum near the starts (7,), the likeliest first, and on the grid around that one.

        `hold` says how firmly the first start is kept where depth tells nothing (`PixelTerms.held_step`).
        """
        if hold > 0 and (settled := self._settled(starts[0], hold)) is not None:
            return settled
        padded = jnp.stack([jnp.asarray(one) for one in [*starts, *[starts[0]] * (3 - len(starts))]])
        located = self._near(padded, hold)
        for _ in range(REFINEMENTS):
            if not located.is_finite:
                break
            is_near = located.is_within(FAR_SHIFT_M, FAR_ANGLE_RAD, padded[0])
            if is_near and hold > 0:
                break
            padded = jnp.stack([located.optimum.pose] * 3)
            again = self._near(padded, hold)
            if not again.is_finite or (is_near and again.log_density <= located.log_density):
                break
            located = again
        return located

    def _settled(self, start: ArrayLike, hold: float) -> Registration | None:
        """The optimum next to a start (7,) whose rendering holds there, too; None where it is not convincing.

        A direction that the view leaves to the start is not: along it there may be better places.
        """
        pose = start
        for _ in range(SETTLING):
            found = self.at(pose, hold)
            if not (found.is_finite and found.is_unambiguous):
                return None
            if hold > LEAST_HELD * found.weakest_share:
                return None
            if found.is_within(SETTLED_SHIFT_M, SETTLED_ANGLE_RAD, pose):
                return found
            pose = found.optimum.pose
        return None

    def _near(self, starts: jax.Array, hold: float) -> Registration:
        indices, local_map = self._local_map(starts[0])
        grid = jnp.asarray(pose_grids.local_grid())
        optimum = local_optimum(local_map, self.view, self.noise, starts, grid, hold)
        found = Registration(optimum, indices, local_map)
        return found if hold > 0 else max(found, self.at(starts[0]), key=attrgetter("log_density"))

    def at(self, pose: ArrayLike, hold: float = 0.0) -> Registration:
        """The optimum next to a pose, which alignment on associated points may leave."""
        indices, local_map = self._local_map(pose)
        optimum = optimum_at(local_map, self.view, self.noise, jnp.asarray(pose), hold)
        return Registration(optimum, indices, local_map)

    def anywhere(self, last: ArrayLike) -> list[Registration]:
        """Distinct optima anywhere in the map, best first; none where no climb leads to what it shows.

        Among the candidates are orbits of the last known pose (7,) round what this view shows.
        """
        distances_m = np.asarray(pose_grids.ORBIT_DISTANCES) * central_depth(self.view)
        places = self._matrices[self._places]
        candidates = pose_grids.grid_everywhere(matrices_of(np.asarray(last)), places, distances_m)
        scores = self._map_scores(candidates, WIDE_BLUR)
        ranked = candidates[np.argsort(-scores, kind="stable")]
        starts = ranked[pose_sets.suppress_similar(ranked, WIDE_CLIMBED, WIDE_SHIFT_M, WIDE_ANGLE_RAD)]
        climbed = self._climbed(starts)
        if not len(climbed):
            return []
        scores = self._map_scores(climbed, CLIMBED_BLUR)
        ranked = climbed[np.argsort(-scores, kind="stable")]
        best = pose_sets.suppress_similar(ranked, WIDE_RENDERED, CLIMBED_SHIFT_M, CLIMBED_ANGLE_RAD)
        rendered = suppress_duplicates([self.at(single_precision_poses(pose)) for pose in ranked[best]])
        meeting = [located for located in rendered if located.explained >= LEAST_EXPLAINED]
        found = [self.near([located.optimum.pose]) for located in meeting[:WIDE_REFINED]]
        return suppress_duplicates(found)

    @cached_property
    def _samples(self) -> NDArray[np.float32]:
        return sample_points(self.view)

    @cached_property
    def _framing(self) -> NDArray[np.float64]:
        return framing(self.view)

    @cached_property
    def _matrices(self) -> NDArray[np.float64]:
        return matrices_of(self.keyframe_poses)

    def _local_map(self, pose: ArrayLike) -> tuple[NDArray[np.int_], LocalMap]:
        chosen = selected_keyframes(
            self.keyframe_map.samples,
            self._matrices,
            self._samples,
            matrices_of(np.asarray(pose)),
            self._framing,
            self.compared,
        )
        return self._stacked(chosen, self.compared)

    def _stacked(self, chosen: NDArray[np.int_], count: int) -> tuple[NDArray[np.int_], LocalMap]:
        present = np.arange(count) < len(chosen)
        indices = np.where(present, np.resize(chosen, count), chosen[0])
        poses = jnp.asarray(self.keyframe_poses[indices])
        return indices, LocalMap(self.keyframe_map.stacked(indices), jnp.asarray(present), poses)

    def _map_scores(self, candidates: NDArray[np.float64], blur: float) -> NDArray[np.float64]:
        """Scores (C,) against all keyframes, `WIDE_KEYFRAMES` at a time; the best set counts."""
        padded = single_precision_poses(pose_sets.pad_to_multiple(candidates, SCORED_AT_ONCE))
        scores = [
            np.concatenate(
                [
                    np.asarray(log_map_scores(local_map, self.view, self.noise, some, blur))
                    for some in jnp.split(padded, len(padded) // SCORED_AT_ONCE)
                ]
            )
            for local_map in self._neighbourhoods()
        ]
        return np.max(scores, axis=0)[: len(candidates)]

    def _climbed(self, starts: NDArray[np.float64]) -> NDArray[np.float64]:
        """Poses (S', 4, 4) uphill of the starts (S, 4, 4), in each neighbourhood; strays are dropped."""
        padded = single_precision_poses(pose_sets.pad_to_multiple(starts, WIDE_CLIMBED))
        climbs = [
            np.asarray(ascend(local_map, self.view, self.noise, padded))[: len(starts)]
            for local_map in self._neighbourhoods()
        ]
        places = np.concatenate(climbs)
        return matrices_of(places[np.isfinite(places).all(axis=1)])

    def _neighbourhoods(self) -> Iterator[LocalMap]:
        """All keyframes that are searched, `WIDE_KEYFRAMES` at a time."""
        for first in range(0, len(self._places), WIDE_KEYFRAMES):
            chosen = self._places[first : first + WIDE_KEYFRAMES]
            yield self._stacked(chosen, WIDE_KEYFRAMES)[1]

    @cached_property
    def _places(self) -> NDArray[np.int_]:
        """All keyframes of a map, or the `WIDE_PLACES` of a large one that resemble the view."""
        if len(self.keyframe_map) <= WIDE_PLACES:
            return np.arange(len(self.keyframe_map))
        distances = place_distances(np.stack(self.keyframe_map.samples), self._samples[:, 2])
        return np.sort(np.argsort(distances, kind="stable")[:WIDE_PLACES])
