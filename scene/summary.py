"""Summary of the samples: means, covariances, modes, edge probabilities, presence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from scene.common_errors import with_common_errors
from scene.config import ParseConfig
from scene.copies import copies_among
from scene.hidden.hidden_places import HiddenPlaces
from scene.mcmc.sampling import SampledScenes, Samples
from scene.model.scene_graph import ROOT
from scene.objects.scene_object import SceneObject
from scene.objects.slots import FoundObjects
from scene.presence.posterior import Presence
from scene.result import SceneResult
from scene.search.search_result import Initialisation
from shapes.geometry.poses import matrices_of, motions_of, poses_of, tangents_of

MODES = 4

MODE_RADIUS_M, MODE_RADIUS_RAD = 0.02, 0.5
"""Poses nearer than both are linked. Twice the centimetre within which benches count a pose as found, and a
third of the quarter turn between two ways in which a box can lie: links never join two of those."""

LINKED = 1000
"""Samples that are linked with each other; of longer chains the others follow the nearest of them."""

MEAN_STEPS = 5


@dataclass(frozen=True, kw_only=True, eq=False)
class Sampled:
    """What chains tell of one scene.

    Attributes:
        found: the objects that they looked at.
        chains: their samples.
        visible_fraction: (N,) of all objects.
        colour_nats: (N,).
    """

    found: FoundObjects
    chains: SampledScenes
    visible_fraction: NDArray[np.float64]
    colour_nats: NDArray[np.float64]


def summarise(
    rng: np.random.Generator,
    sampled: Sampled,
    start: Initialisation,
    hidden: HiddenPlaces,
    presence: Presence,
    world_from_camera: NDArray[np.float64],
    objects: Sequence[SceneObject],
    frames: NDArray[np.int64],
    config: ParseConfig,
) -> SceneResult:
    """The result in the searched camera and in the objects' own frames; what was not found stands still.

    Args:
        rng: random numbers.
        sampled: by chains.
        start: the best scene of all objects.
        hidden: what is known of objects out of sight.
        presence: of all, but for those in `hidden` that were asked for exactly and are not in sight. Of what
            chains show nowhere that is told which it has out of sight.
        world_from_camera: (4, 4).
        objects: all N.
        frames: numbers of the frames used.
        config: settings.
    """
    samples, chosen, count = sampled.chains.samples, sampled.found, len(objects)
    kept, runs = samples.log_posterior.shape
    flat = jax.tree.map(lambda leaf: leaf.reshape(kept * runs, *leaf.shape[2:]), samples)
    flat = _of_all(flat, chosen)
    box_from_object = np.stack([one.box_from_object for one in objects])
    starts, in_world = matrices_of(start.poses), matrices_of(flat.poses)
    boxes = np.where(start.found[:, None, None], np.linalg.inv(world_from_camera) @ in_world, starts[None])
    modes = [pose_modes(boxes[:, one]) for one in range(count)]
    means = np.stack([one.centres[0] for one in modes]) @ box_from_object
    most_probable = boxes[int(flat.log_posterior.argmax())] @ box_from_object
    radii_m = np.array([np.linalg.norm(one.half_extents_m) for one in objects], np.float64)
    there = with_common_errors(rng, boxes, radii_m, config.scale_error, config.model_error_m)
    poses = np.where(start.found[:, None, None], there, boxes) @ box_from_object
    alike = copies_among({one.name: one.points_m for one in objects})
    left = presence.seen & (sampled.visible_fraction == 0)  # chains found it likelier beside the image
    presence = presence.without_sight_of(left, alike)
    exact = {one: told for one, told in hidden.exact.items() if not presence.seen[one]}
    presence = presence.with_exact(exact, hidden.both, alike)
    edges, faces = _edges(flat, count, max(samples.parents.shape[-1] - chosen.slots, 1))
    return SceneResult(
        names=np.array([one.name for one in objects]),
        frames=np.asarray(frames, np.int64),
        camera_from_object=means,
        covariance=np.stack([second_moment(poses[:, one], means[one]) for one in range(count)]),
        most_probable=most_probable,
        presence=presence.probability,
        presence_std=presence.standard_error,
        hidden_presence=presence.hidden,
        number_probabilities=presence.number,
        hidden_share=np.where(start.found & ~left, 0.0, hidden.share),  # moves may have put it in since
        hidden_poses=poses_of(np.linalg.inv(world_from_camera) @ hidden.poses @ box_from_object[:, None]),
        visible_fraction=sampled.visible_fraction,
        colour_nats=sampled.colour_nats,
        mode_poses=np.stack([one.centres for one in modes]) @ box_from_object[:, None],
        mode_probabilities=np.stack([one.shares for one in modes]),
        sample_modes=np.stack([one.labels for one in modes], axis=1),
        edge_probabilities=edges,
        edge_faces=faces,
        sample_poses=poses_of(poses),
        sample_parents=flat.parents,
        sample_log_posteriors=flat.log_posterior,
        chain=np.tile(np.arange(runs, dtype=np.int32), kept),
        acceptance=np.asarray(np.mean(flat.accepted), np.float64),
        log_estimate_variance=np.asarray(sampled.chains.log_estimate_variance),
    )


def _of_all(flat: Samples, chosen: FoundObjects) -> Samples:
    """Samples (S, ...) of slots as those of all objects; what was not found floats nowhere."""
    kept = len(flat.log_posterior)
    parents = chosen.parents(flat.parents)
    nowhere = np.tile([1.0, 0, 0, 0, 0, 0, 0], (kept, chosen.count, 1))
    none = np.zeros((kept, chosen.count), np.int32)
    return Samples(
        chosen.spread(flat.poses, nowhere),
        chosen.spread(parents, none + ROOT),
        chosen.spread(flat.parent_faces, none),
        chosen.spread(flat.child_faces, none),
        flat.log_posterior,
        flat.accepted,
    )


@dataclass(frozen=True)
class PoseModes:
    """The groups that samples of one pose fall into, the heaviest first.

    Attributes:
        centres: (MODES, 4, 4) mean of the samples round the densest one of each group; identity without.
        shares: (MODES,) of all samples, 0 where there are fewer groups.
        labels: (S,) int32 the group of each sample, -1 in none of those told.
    """

    centres: NDArray[np.float64]
    shares: NDArray[np.float64]
    labels: NDArray[np.int32]


def pose_modes(poses: NDArray[np.float64]) -> PoseModes:
    """Groups of samples (S, 4, 4) by single linkage: a chain of near poses joins any two of a group.

    A can that may stand at any angle about its axis is one group and its spread is the whole circle; a box
    that may lie either way round is two. The pose should be that of the object's centre, so that a turn in
    place moves nothing.
    """
    linked = np.unique(np.linspace(0, len(poses) - 1, min(LINKED, len(poses))).round().astype(int))
    near = _near(poses[linked], poses[linked])
    _, group = connected_components(near, directed=False)
    order = np.argsort(-np.bincount(group), kind="stable")[:MODES]
    rank = np.full(group.max() + 1, -1, np.int32)
    rank[order] = np.arange(len(order))
    centres = np.tile(np.eye(4), (MODES, 1, 1))
    for mode, number in enumerate(order):
        members = np.flatnonzero(group == number)
        densest = members[near[np.ix_(members, members)].sum(axis=1).argmax()]
        centres[mode] = _mean(poses[linked][near[densest]], poses[linked[densest]])
    labels = rank[group][_nearest(poses, poses[linked])]
    shares = np.bincount(labels[labels >= 0], minlength=MODES) / len(poses)
    return PoseModes(centres=centres, shares=shares, labels=labels)


def second_moment(poses: NDArray[np.float64], mean: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of samples (S, 4, 4) round a pose (4, 4), as (6, 6) in the right tangent there."""
    tangents = tangents_of(np.linalg.inv(mean) @ poses)
    return tangents.T @ tangents / len(tangents)


def _mean(poses: NDArray[np.float64], start: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean (4, 4) of poses (S, 4, 4) that lie together, found from one of them on."""
    mean = start
    for _ in range(MEAN_STEPS):
        mean = mean @ motions_of(tangents_of(np.linalg.inv(mean) @ poses).mean(axis=0))
    return mean


def _near(poses: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(S, O) which of the poses are linked."""
    distance = np.linalg.norm(poses[:, None, :3, 3] - others[None, :, :3, 3], axis=2)
    return (distance < MODE_RADIUS_M) & (_cosine(poses, others) > np.cos(MODE_RADIUS_RAD))


def _nearest(poses: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.int_]:
    """(S,) the nearest of the others, in units of the linking distances."""
    nearest = np.empty(len(poses), int)
    for first in range(0, len(poses), LINKED):
        some = poses[first : first + LINKED]
        squared = ((some[:, None, :3, 3] - others[None, :, :3, 3]) ** 2).sum(axis=2) / MODE_RADIUS_M**2
        squared += np.arccos(np.clip(_cosine(some, others), -1, 1)) ** 2 / MODE_RADIUS_RAD**2
        nearest[first : first + LINKED] = squared.argmin(axis=1)
    return nearest


def _cosine(poses: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """(S, O) cosine of the angle of the rotation between two poses."""
    return (np.einsum("sij,oij->so", poses[:, :3, :3], others[:, :3, :3], optimize=True) - 1) / 2


def _edges(flat: Samples, count: int, supports: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Probability (N, N + S) of every edge, and its most frequent faces (N, N + S, 2)."""
    pairs = flat.child_faces * 6 + flat.parent_faces
    probabilities = np.zeros((count, count + supports))
    faces = np.full((count, count + supports, 2), -1, np.int32)
    for child in range(count):
        for parent in np.unique(flat.parents[:, child][flat.parents[:, child] != ROOT]):
            on = flat.parents[:, child] == parent
            probabilities[child, parent] = on.mean()
            faces[child, parent] = np.divmod(np.bincount(pairs[on, child]).argmax(), 6)
    return probabilities, faces
