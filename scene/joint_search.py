"""The search in several frames of a scene at rest: what one does not show, another does.

Frames that show something new are searched, each by itself (`scene.initialisation`). Every object is then
where one of these searches has it, or absent, as the density of all frames and the prior odds say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from recordings.types import DepthNoise
from scene.config import ParseConfig
from scene.initialisation import initialise
from scene.likelihood.compared_frames import ComparedFrames
from scene.likelihood.object_renderer import ObjectRenderer
from scene.likelihood.unknown_surfaces import UnknownWeights
from scene.model.number_prior import LOG_SPINS, log_prior_odds
from scene.objects.scene_object import SceneObject
from scene.observation.frame_data import SceneData
from scene.presence.depth_candidates import PresenceFrames, nearest_shown
from scene.presence.size_prior import SizePrior
from scene.search.search_result import Initialisation
from scene.search.support_prior import log_not_buried
from shapes.geometry.poses import matrices_of, poses_of, transform_points

NEW_M = 0.015
"""What is so far from all that other frames show is new, and counts by cells of that edge."""

WORTH = 0.25
"""New cells over those known for which a third frame, or a later one, is searched: that takes seconds."""

ABSENT = -1


@dataclass(frozen=True, kw_only=True, eq=False)
class JointStart:
    """Where chains start that see several frames.

    Attributes:
        compared: the frames.
        start: the best scene, and pools, in the camera of the frame `compared.searched`.
        frames: (N,) number of the frame in which each object was found, or looked for.
        searched: the frames that were searched, by number, with the foreground that is new in each.
    """

    compared: ComparedFrames
    start: Initialisation
    frames: NDArray[np.intp]
    searched: Mapping[int, SceneData]


def search_frames(
    keys: Sequence[jax.Array],
    views: Sequence[SceneData],
    first_camera_from_camera: NDArray[np.float64],
    objects: Sequence[SceneObject],
    renderer: ObjectRenderer,
    noise: DepthNoise,
    learned: UnknownWeights,
    config: ParseConfig,
) -> JointStart:
    """The best scene that the frames show.

    Args:
        keys: of the search in the first frame that is searched, and of those in others.
        views: F frames.
        first_camera_from_camera: (F, 4, 4) poses relative to the first of them.
        objects: N that are looked for.
        renderer: of these.
        noise: of the sensor.
        learned: how well pixels foretell each other.
        config: settings.

    Raises:
        ValueError: no frame shows anything but supports.
    """
    key, other_key = keys
    searched = worth_searching(views, first_camera_from_camera)
    first, numbers = next(iter(searched)), np.array(list(searched))
    compared = ComparedFrames.of(views, first, first_camera_from_camera, objects, noise, learned, config)
    starts = []
    frame_keys = [key, *jax.random.split(other_key, len(searched) - 1)]
    for number, frame_key in zip(searched, frame_keys, strict=True):
        start = initialise(frame_key, views[number], objects, renderer, noise, config, learned)
        if number != first:
            start = start.seen_from(compared.searched_from(number))
        starts.append(start)
    rows = np.zeros(len(objects), np.intp)
    start = starts[0]
    if len(starts) > 1:
        told = _best_of_each(compared, objects, renderer, starts, config)
        alone = np.argmax([one.log_alone[:, :-1].max(axis=1) for one in starts], axis=0)
        rows = np.where(told == ABSENT, alone, told)
        start = replace(Initialisation.of_each(starts, rows), found=told != ABSENT)
    return JointStart(compared=compared, start=start, frames=numbers[rows], searched=searched)


def worth_searching(
    views: Sequence[SceneData], first_camera_from_camera: NDArray[np.float64]
) -> dict[int, SceneData]:
    """The frames to be searched, by number, with the foreground that those before them do not show.

    The first that shows anything, then those with most that is new: a second one always, further ones while
    they show enough.

    Raises:
        ValueError: none shows anything.
    """
    points = [_foreground(*one) for one in zip(views, first_camera_from_camera, strict=True)]
    showing = [number for number, one in enumerate(points) if len(one)]
    if not showing:
        raise ValueError("nothing stands on the supports that the frames show: choose others with --frames")
    first = showing.pop(0)
    chosen, known = {first: views[first]}, points[first]
    while showing:
        tree = KDTree(known)
        new = {number: tree.query(points[number])[0] > NEW_M for number in showing}
        cells = [_cells(points[number][new[number]]) for number in showing]
        most = int(np.argmax(cells))
        if cells[most] == 0 or (len(chosen) > 1 and cells[most] < WORTH * _cells(known)):
            break
        number = showing.pop(most)
        foreground = views[number].foreground.copy()
        foreground[foreground] = new[number]
        chosen[number] = replace(views[number], foreground=foreground)
        known = np.concatenate([known, points[number]])
    return chosen


def visible_fractions(
    joint: JointStart,
    renderer: ObjectRenderer,
    found: NDArray[np.bool_],
    world_from_box: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Shares (N,) of the pixels of each object `found` (N,) that nothing hides, in the frame of its search.

    Or in the first frame that shows it, where that one does not: moves may have put it elsewhere since.
    Neither another object or a support, nor what is measured nearer than its surface, whatever that is. Of
    what is in the scene they are more than 0, unless it is beside all images.

    Args:
        joint: the frames.
        renderer: of all objects.
        found: which are in the scene.
        world_from_box: (N, 7) their poses.
    """
    shares, numbers = np.zeros(len(found)), np.arange(len(found))
    own = [(frame, joint.frames == frame) for frame in np.unique(joint.frames).tolist()]
    every = [(frame, found) for frame in range(len(joint.compared.views))]
    for frame, of_frame in [*own, *every]:
        mine = found & of_frame & (shares == 0)
        if not mine.any():
            continue
        in_camera = poses_of(joint.compared.camera_from_world[frame] @ matrices_of(world_from_box))
        layers_m = renderer.layers(numbers, in_camera, joint.compared.views[frame].window)
        layers_m[~found] = np.inf
        covers = np.isfinite(layers_m)
        hidden = layers_m > layers_m.min(axis=0)
        hidden |= layers_m > joint.compared.views[frame].rest_m
        hidden |= joint.compared.densities[frame].measured_before(layers_m)
        count = np.maximum(covers.sum(axis=(1, 2)), 1)
        seen = (covers & ~hidden).sum(axis=(1, 2))
        shares[mine] = (np.maximum(seen, covers.any(axis=(1, 2))) / count)[mine]
    return shares


def _foreground(view: SceneData, first_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (N, 3) in the first camera's frame that may show an object."""
    return transform_points(first_from_camera, view.view.points_m[view.foreground])


def _cells(points_m: NDArray[np.float64]) -> int:
    """Cells of edge NEW_M that points (N, 3) lie in."""
    return len(np.unique(points_m // NEW_M, axis=0))


def _best_of_each(
    compared: ComparedFrames,
    objects: Sequence[SceneObject],
    renderer: ObjectRenderer,
    starts: Sequence[Initialisation],
    config: ParseConfig,
) -> NDArray[np.intp]:
    """Which of the searches (N,) has each object in the best scene, ABSENT where none has."""
    count, log_half = len(objects), SizePrior.of(objects, config.model_error_m).log_half
    frames = PresenceFrames(compared=compared, renderer=renderer, log_half=log_half)
    in_world = compared.world_from_camera @ matrices_of(np.concatenate([one.poses for one in starts]))
    states = np.concatenate([poses_of(in_world), np.tile(log_half, (len(starts), 1))], axis=1)
    shown = frames.shown(np.tile(np.arange(count), len(starts)), states)
    depth_m, log_gain = (part.reshape(len(starts), count, -1) for part in shown)
    found = np.stack([one.found for one in starts])
    log_odds = np.full(found.shape, log_prior_odds(config.presence))
    log_odds += np.where([one.spin_line.any() for one in objects], LOG_SPINS, 0.0)
    by_object = states[:, :7].reshape(len(starts), count, 7).swapaxes(0, 1)
    log_odds += log_not_buried(compared.table, objects, by_object, config.contact_sigma_m).T
    return best_choice(depth_m, log_gain, found, log_odds)


def best_choice(
    depth_m: NDArray[np.float32],
    log_gain: NDArray[np.float32],
    found: NDArray[np.bool_],
    log_odds: NDArray[np.float64],
) -> NDArray[np.intp]:
    """Which of V places (N,) each of N objects takes, ABSENT for none.

    From the scene of all first places, of all second ones, ..., objects are changed one by one while the
    density grows.

    Args:
        depth_m: (V, N, X) at which an object in a place hides others, +inf where it shows nothing.
        log_gain: (V, N, X) log density of the pixel there, less that of the scene without objects.
        found: (V, N) whether an object may take that place.
        log_odds: (V, N) prior, of an object that is there, in that place.
    """
    places, count = found.shape

    def value(scene: NDArray[np.intp]) -> float:
        there = np.flatnonzero(scene != ABSENT)
        if not len(there):
            return 0.0
        _, gains = nearest_shown(depth_m[scene[there], there], log_gain[scene[there], there])
        return float(gains.sum(dtype=np.float64) + log_odds[scene[there], there].sum())

    def improved(scene: NDArray[np.intp]) -> tuple[float, NDArray[np.intp]]:
        best, before = value(scene), -np.inf
        while best > before:
            before = best
            for one in range(count):
                for place in [ABSENT, *np.flatnonzero(found[:, one]).tolist()]:
                    other = np.where(np.arange(count) == one, place, scene)
                    if (told := value(other)) > best:
                        best, scene = told, other
        return best, scene

    scenes = [np.where(found[place], place, ABSENT) for place in range(places)]
    return max((improved(scene) for scene in scenes), key=lambda one: one[0])[1]
