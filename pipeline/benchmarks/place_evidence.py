"""Log evidence of a thing in one place beside that of it in another, by the density of `parse`.

The evidence of a place is the sum over all scenes with the thing there: over its poses about the place, and
over the unknown boxes and cylinders that may stand anywhere. Candidates are drawn as presence draws them; the
sum over scenes of these is estimated one slot after the other, by the product of the sums over each slot's
options given those before, whose mean is the sum itself (sequential importance sampling).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, softmax

from recordings.types import CameraIntrinsics, DepthNoise, Frame
from scene.config import ParseConfig
from scene.likelihood.compared_frames import ComparedFrames
from scene.likelihood.object_renderer import ObjectRenderer
from scene.likelihood.unknown_surfaces import UnknownWeights
from scene.objects.orientations import cube_rotations
from scene.objects.scene_object import SceneObject
from scene.observation.segmentation import scene_data
from scene.presence.births import born_near, distinct
from scene.presence.depth_candidates import PresenceFrames
from scene.presence.pose_priors import PosePriors
from scene.presence.posterior import Births, drawn_ensemble
from scene.presence.size_prior import SizePrior
from scene.presence.solid_births import competing_solids
from scene.presence.toggling import ABSENT, Candidates
from shapes.geometry.poses import matrices_of, poses_of

ORDERS = 32
"""In which the slots of what else may be there are gone through."""
TRIED = 2
"""Places of those in a decoy, the likeliest ones, of which the evidence is computed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlaceEvidence:
    """The frame and the priors by which places of one known thing are weighed.

    Attributes:
        one: the thing.
        compared: the frame, with its density.
        config: of the parse.
    """

    one: SceneObject
    compared: ComparedFrames
    config: ParseConfig

    @classmethod
    def of(
        cls, frame: Frame, intrinsics: CameraIntrinsics, one: SceneObject, config: ParseConfig, seed: int
    ) -> PlaceEvidence:
        """Of a frame, prepared as `parse` does."""
        view = scene_data(frame.depth_m, intrinsics, seed)
        noise = replace(DepthNoise(), outlier_probability=config.outlier_probability)
        learned = UnknownWeights.learned([view.window.depth_m], noise)
        compared = ComparedFrames.of([view], 0, np.eye(4)[None], [one], noise, learned, config)
        return cls(one=one, compared=compared, config=config)

    def likeliest(self, camera_from_box: NDArray[np.float64]) -> NDArray[np.float64]:
        """Those `TRIED` of poses (S, 4, 4), apart from each other, that explain most by themselves."""
        poses, frames = self._in_world(camera_from_box), self._frames(1)
        states = np.concatenate([poses, np.tile(frames.log_half[0], (len(poses), 1))], axis=1)
        _, gain = frames.shown(np.zeros(len(poses), np.intp), states, np.zeros(len(poses), np.intp))
        order = np.argsort(-gain.sum(axis=1, dtype=np.float64), kind="stable")
        world_from_camera = self.compared.world_from_camera
        return np.linalg.inv(world_from_camera) @ matrices_of(distinct(poses[order])[:TRIED])

    def log_evidence(
        self, camera_from_box: NDArray[np.float64], seed: int
    ) -> tuple[float, NDArray[np.float64]]:
        """Without the thing, and with it near each of poses (S, 4, 4); all over one constant."""
        rng = np.random.default_rng(seed)
        candidates = self._candidates(rng, camera_from_box)
        count = len(camera_from_box)
        absent = log_scenes(rng, candidates, range(count, candidates.slots), None, ORDERS)
        there = [
            log_scenes(rng, candidates, range(count, candidates.slots), place, ORDERS)
            for place in range(count)
        ]
        return absent, np.array(there)

    def _candidates(self, rng: np.random.Generator, camera_from_box: NDArray[np.float64]) -> Candidates:
        """A slot for each of the places, and one for each unknown solid."""
        count = len(camera_from_box)
        frames, priors = self._frames(count), self._priors(count, camera_from_box)
        sites = [pose[None] for pose in self._in_world(camera_from_box)]
        lines = np.tile(self.one.spin_line, (count, 1, 1))
        (mixture,) = born_near(rng, frames, priors, sites, lines, np.zeros(count, int), 1)
        solids = competing_solids(rng, frames, priors, {self.compared.searched: self.compared.data}, mixture)
        nowhere = np.full(count, -np.inf)
        births = Births(mixture=mixture, solids=solids)
        return drawn_ensemble(rng, frames, priors, births, nowhere, None).candidates

    def _frames(self, count: int) -> PresenceFrames:
        objects = [self.one] * count
        sizes = SizePrior.of(objects, self.config.model_error_m)
        return PresenceFrames(
            compared=self.compared, renderer=ObjectRenderer.of(objects), log_half=sizes.log_half
        )

    def _priors(self, count: int, camera_from_box: NDArray[np.float64]) -> PosePriors:
        """Of scenes with one of the places at most."""
        supports, objects = self.compared.data.supports[:1], [self.one] * count
        centres_m = self._in_world(camera_from_box)[:, 4:]
        return PosePriors.over(self.compared, supports, objects, 1, centres_m, self.config)

    def _in_world(self, camera_from_box: NDArray[np.float64]) -> NDArray[np.float64]:
        return poses_of(self.compared.world_from_camera @ camera_from_box)


def log_scenes(
    rng: np.random.Generator, candidates: Candidates, others: Sequence[int], place: int | None, orders: int
) -> float:
    """Log of the sum of the weights of all scenes of the slots `others`, with slot `place` taken.

    -inf where the prior excludes all of its candidates, as deep below the table.

    Args:
        rng: random numbers.
        candidates: of all slots.
        others: slots that may be taken.
        place: a slot that is; None for none.
        orders: in which the slots are gone through, one independent estimate each.
    """
    empty = np.full(candidates.slots, ABSENT)
    totals = np.full(orders, candidates.log_weights(empty, [others[0]])[0] if len(others) else 0.0)
    for number in range(orders):
        scene = empty.copy()
        for slot in rng.permutation([*others, *([] if place is None else [place])]).astype(int).tolist():
            weights = candidates.log_weights(scene, [slot])
            base = weights[0]
            options = np.where(np.arange(len(weights)) == 0, -np.inf, weights) if slot == place else weights
            if not np.isfinite(options).any():
                totals[number] = -np.inf
                break
            totals[number] += logsumexp(options) - base
            chosen = rng.choice(len(options), p=softmax(options)) - 1
            scene[slot] = chosen if chosen >= 0 else ABSENT
    return float(logsumexp(totals) - np.log(orders))


def laid_into(
    world_from_decoy: NDArray[np.float64], half_m: NDArray[np.float64], own_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Poses (S, 4, 4) of a box of half sizes own_m, its faces in those of a box of half sizes half_m.

    All 24 ways of turning it, at every corner, edge and face, flush with that from within.
    """
    turns = cube_rotations()
    corners = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    corners = corners[(corners != 0).any(axis=1)]
    poses = np.tile(np.eye(4), (len(turns), len(corners), 1, 1))
    poses[..., :3, :3] = turns[:, None]
    room_m = half_m - np.abs(turns) @ own_m
    poses[..., :3, 3] = corners * room_m[:, None]
    return world_from_decoy @ poses.reshape(-1, 4, 4)
