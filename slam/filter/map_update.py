"""Map update by a registered frame: noise calibration, then fusion into a keyframe, or a new keyframe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from shapes.geometry.pose_sets import within_reach
from shapes.geometry.poses import matrices_of, relative_pose
from slam.filter.rival_motion import Doubt
from slam.filter.state import FilterState
from slam.keyframes.depth_view import CanvasView, central_depth
from slam.keyframes.fusion import fuse
from slam.keyframes.surfels import surfel_image, with_noise
from slam.registration.registered import Registration

KEYFRAME_SHIFT = 0.1
"""A frame whose camera moved this far from its anchor, in median scene depths, becomes a keyframe."""

KEYFRAME_ANGLE_RAD = 0.2
"""Chosen by hand; more keyframes cost time, fewer drift (kitchen rows of `bench slam`)."""

KEYFRAME_COVERAGE = 0.75
"""Chosen by hand; as `KEYFRAME_ANGLE_RAD`."""


def with_frame(state: FilterState, view: CanvasView, best: Registration, doubt: Doubt) -> FilterState:
    """The frame teaches the sensor, and refines its anchor or, seen from elsewhere, becomes a keyframe.

    A new keyframe stands where each hypothesis has the camera. While several places compete, no depth is
    fused: the surfaces are shared by hypotheses that disagree.
    """
    anchor = int(best.indices[0])
    state = with_calibration(state, best)
    anchor_pose, pose = best.local_map.poses[0], best.optimum.pose
    reach = KEYFRAME_SHIFT * central_depth(view), KEYFRAME_ANGLE_RAD
    near = within_reach(matrices_of(anchor_pose), matrices_of(pose), *reach)
    keyframe_map, noise = state.keyframe_map, state.calibration.noise
    if near and best.covered >= KEYFRAME_COVERAGE:
        if len(state.population) > 1:
            return state
        refined = fuse(keyframe_map.surface(anchor), view, relative_pose(anchor_pose, pose), noise)
        return replace(state, keyframe_map=keyframe_map.with_refined(anchor, refined))
    new = len(keyframe_map)
    pairs = np.stack([np.full(len(best.indices), new), best.indices], axis=1).astype(np.int32)
    grown = tuple(
        replace(
            one,
            keyframe_poses=np.concatenate([one.keyframe_poses, one.pose[None]]),
            overlaps=np.unique(np.concatenate([one.overlaps, pairs]), axis=0),
            anchor=new,
        )
        for one in state.population.histories
    )
    surface = surfel_image(view, noise)
    return replace(
        state,
        population=replace(state.population, histories=grown),
        keyframe_map=keyframe_map.with_keyframe(surface),
        rival=state.rival.with_keyframe(surface, pose, doubt),
        keyframe_times_ns=(*state.keyframe_times_ns, state.times_ns[1]),
    )


def with_calibration(state: FilterState, located: Registration) -> FilterState:
    """The sensor after one frame more; surfaces keep the variances of the sensor that is now believed."""
    calibration = state.calibration
    if not calibration.is_learning:
        return state
    optimum = located.optimum
    learnt = calibration.after(
        np.asarray(optimum.squared_ratio, np.float64),
        np.asarray(optimum.inlier_count, np.float64),
        np.asarray(optimum.layer_precisions, np.float64).sum(0),
        np.asarray(optimum.score_variance, np.float64),
    )
    keyframe_map = state.keyframe_map
    if not calibration.fixed_sigma:
        for index in range(len(keyframe_map)):
            surface = with_noise(keyframe_map.surface(index), calibration.noise, learnt.noise)
            keyframe_map = keyframe_map.with_refined(index, surface)
    return replace(state, calibration=learnt, keyframe_map=keyframe_map)
