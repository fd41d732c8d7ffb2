"""The filter's `step`, one frame further (`slam.filter.init` begins it), and its report of the frame.

A step finds where each hypothesis may have the frame (`slam.filter.pose_hypotheses`), takes each place as
a Gaussian with its evidence (`slam.filter.places`), runs the generic sequential Monte Carlo step
(`slam.filter.smc`), and fuses the frame into the map or adds it as a keyframe (`slam.filter.map_update`).
Reported poses are relative to a keyframe, so that later refinement of the keyframe carries them along.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from shapes.geometry.pose_sets import within_reach
from shapes.geometry.poses import matrices_of, relative_pose
from slam.config import LEAST_PROBABILITY, SlamConfig
from slam.filter import smc
from slam.filter.map_update import with_calibration, with_frame
from slam.filter.motion import is_wide_step
from slam.filter.places import Place, place_at
from slam.filter.pose_hypotheses import Found, find_places, predict
from slam.filter.rival_motion import CERTAIN, Doubt, doubt_of_frame
from slam.filter.state import FilterState, FoundPlaces, FrameInfo, Hypothesis, Ties
from slam.keyframes.depth_view import CanvasView, farthest_depth
from slam.likelihood.distortion import NODES, NodeWeights
from slam.registration.field_sensitivity import field_sensitivity
from slam.registration.registered import Registration

MOST_HYPOTHESES = 8
"""Search effort: each looks for every frame."""


@dataclass(frozen=True)
class _Branch:
    """A hypothesis with one frame more.

    Attributes:
        hypothesis: it.
        located: where that is; None where the frame is lost.
        place: the posterior there.
    """

    hypothesis: Hypothesis
    located: Registration | None = None
    place: Place | None = None


def step(
    key: jax.Array,
    state: FilterState,
    view: CanvasView,
    time_ns: int,
    config: SlamConfig,
    odometry: NDArray[np.float64] | None = None,
) -> tuple[FilterState, FrameInfo]:
    """One frame further.

    Args:
        key: consumed.
        state: after the previous frame.
        view: the frame.
        time_ns: its stamp.
        config: settings.
        odometry: (4, 4) previous_from_camera by KISS-ICP, where it is used: one more start of the search.
    """
    state = replace(state, calibration=state.calibration.reaching(farthest_depth(view)))
    prediction = predict(state, time_ns)
    found = find_places(state, view, prediction, config, odometry)
    if state.calibration.is_learning and state.calibration.frames == 0 and not found.lost:
        state = with_calibration(state, found.best)
        found = find_places(state, view, prediction, config, odometry)
    branches, info = _branched(key, state, found, prediction.poses)
    moved = replace(
        state,
        population=smc.Population(tuple(one.hypothesis for one in branches.histories), branches.log_weights),
        times_ns=(state.times_ns[1], state.times_ns[1] if found.lost else time_ns),
        lost_frames=state.lost_frames + 1 if found.lost else 0,
        contradicted=state.contradicted or found.contradicted,
    )
    best, doubt = branches.heaviest.located, CERTAIN
    if best is not None and config.second_motion:
        anchor = int(best.indices[0]), best.local_map.poses[0]
        rival, doubt = doubt_of_frame(state.rival, view, state.calibration, best.optimum.pose, *anchor)
        moved = replace(moved, rival=rival)
    if best is not None:
        moved = with_frame(moved, view, best, doubt)
    heaviest = moved.population.heaviest
    is_wide = is_wide_step(heaviest.previous_pose, heaviest.pose)
    moved = replace(moved, steps_were_wide=state.steps_were_wide or is_wide)
    return moved, _frame_info(state, moved, view, branches, info, found, doubt)


def _branched(
    key: jax.Array, state: FilterState, found: Found, predictions: NDArray[np.float32]
) -> tuple[smc.Population[_Branch], smc.StepInfo]:
    """Every hypothesis at its places, each with its evidence; where the frame is lost they stay as they are.

    Of those that have all keyframes and the frame in one place one goes on.
    """

    def branch(index: int, hypothesis: Hypothesis) -> Sequence[tuple[_Branch, float]]:
        if found.lost:
            return [(_Branch(replace(hypothesis, previous_pose=hypothesis.pose)), 0.0)]
        past = state.past_of(hypothesis, predictions[index])
        children = []
        for located in found.of_hypotheses[index]:
            place = place_at(
                located.optimum, located.local_map, past, state.motion, state.calibration.exponent
            )
            moved = replace(
                hypothesis,
                pose=place.pose,
                previous_pose=hypothesis.pose,
                anchor=int(located.indices[0]),
            )
            children.append((_Branch(moved, located, place), place.log_evidence))
        return children

    step_key, merge_key = jax.random.split(key)
    branches, info = smc.step(step_key, state.population, branch, MOST_HYPOTHESES, LEAST_PROBABILITY)
    if len(branches) == 1:
        return branches, info
    branches, kept = smc.merged(
        merge_key, branches, lambda one, other: _alike(one.hypothesis, other.hypothesis)
    )
    return branches, replace(info, ancestors=info.ancestors[kept])


def _alike(one: Hypothesis, other: Hypothesis) -> bool:
    """Whether two have all keyframes and the last frame in one place, so that they go on alike."""
    first, second = (
        matrices_of(np.concatenate([each.keyframe_poses, each.pose[None]])) for each in (one, other)
    )
    return bool(within_reach(first, second).all())


def _frame_info(
    before: FilterState,
    state: FilterState,
    view: CanvasView,
    branches: smc.Population[_Branch],
    info: smc.StepInfo,
    found: Found,
    doubt: Doubt,
) -> FrameInfo:
    """The report of a frame that led from one state to another."""
    is_keyframe = len(state.keyframe_map) > len(before.keyframe_map)
    best, probabilities = branches.heaviest.located or found.best, branches.probabilities
    return FrameInfo(
        places=_places(before, view, branches, info, found, follows=not is_keyframe),
        log_evidence=info.log_evidence,
        hypotheses=float(1.0 / (probabilities**2).sum()),
        resampled=info.resampled,
        lost=found.lost,
        unexpected=found.unexpected,
        explained=best.explained,
        keyframes=len(state.keyframe_map),
        is_keyframe=is_keyframe,
        doubt=doubt,
    )


def _places(
    state: FilterState,
    view: CanvasView,
    branches: smc.Population[_Branch],
    info: smc.StepInfo,
    found: Found,
    *,
    follows: bool,
) -> FoundPlaces:
    """Where the branches have the frame; it follows keyframes and the field, or is lost or one of them."""
    compared = len(found.best.indices)
    of_all = []
    for one in branches.histories:
        indices = found.best.indices if one.located is None else one.located.indices
        anchor = one.hypothesis.keyframe_poses[int(indices[0])]
        covariance = (1.0 + state.lost_frames) * state.unseen_step
        following = np.zeros((6, NODES), np.float32)
        ties = np.tile(np.asarray(anchor), (compared, 1)), np.zeros((compared, 6, 6), np.float32)
        if one.located is not None and one.place is not None:
            covariance = one.place.covariance
            if follows:
                following = np.asarray(_field_sensitivity(state, view, one.located, one.place))
                ties = one.place.keyframes_from_camera, one.place.shares
        relative = np.asarray(relative_pose(anchor, one.hypothesis.pose))
        of_all.append((indices[0], relative, covariance, following, indices, *ties))
    anchors, relative, covariances, following, indices, from_camera, shares = (
        np.stack(leaves) for leaves in zip(*of_all, strict=True)
    )
    return FoundPlaces(
        anchors=anchors.astype(np.int32),
        relative_poses=relative,
        covariances=covariances.astype(np.float32),
        field_sensitivity=following,
        ties=Ties(indices.astype(np.int32), from_camera, shares.astype(np.float32)),
        ancestors=info.ancestors,
    )


def _field_sensitivity(
    state: FilterState, view: CanvasView, located: Registration, place: Place
) -> jax.Array:
    """Of a place's pose, whose covariance was tempered."""
    calibration, nodes = state.calibration, NodeWeights.of(view)
    tempered = jnp.asarray(calibration.exponent * place.covariance, jnp.float32)
    return field_sensitivity(located.optimum, located.local_map, view, nodes, calibration.noise, tempered)
