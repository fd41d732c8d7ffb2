"""The filter's `init`: the first frame with enough returns is the reference and the first keyframe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from shapes.geometry.pose_sets import IDENTITY
from slam.config import SlamConfig
from slam.filter import smc
from slam.filter.motion import FreeMotion, MotionPrior, OrbitMotion, spread_of_a_step
from slam.filter.rival_motion import CERTAIN, RivalMotion
from slam.filter.state import FilterState, FoundPlaces, FrameInfo, Hypothesis, Ties
from slam.keyframes.depth_view import CanvasView, central_depth, farthest_depth
from slam.keyframes.keyframe_map import KeyframeMap
from slam.keyframes.pages import PageFile
from slam.keyframes.surfels import surfel_image
from slam.likelihood.distortion import NODES
from slam.likelihood.noise_calibration import NoiseCalibration

LOOSE_RADIUS = 0.15
"""Relative standard deviation of an orbit's radius that nobody gave."""


def init(
    view: CanvasView, time_ns: int, config: SlamConfig, pages: PageFile | None = None
) -> tuple[FilterState, FrameInfo]:
    """The state after the first frame, which is the reference and the first keyframe.

    Args:
        view: of the frame.
        time_ns: its stamp.
        config: settings.
        pages: where keyframes go that are not asked for; None keeps them in memory.
    """
    radius = config.orbit_radius_m or central_depth(view)
    motion: MotionPrior = FreeMotion.default()
    if config.motion == "orbit":
        known = config.orbit_radius_m is not None
        motion = OrbitMotion.default() if known else OrbitMotion.of_unknown_radius(LOOSE_RADIUS * radius)
    calibration = NoiseCalibration.initial(config.noise, config.effective_pixel_share)
    calibration = calibration.reaching(farthest_depth(view))
    here, pivot = np.asarray(IDENTITY, np.float32), np.asarray([0.0, 0.0, radius], np.float32)
    surface = surfel_image(view, calibration.noise)
    state = FilterState(
        population=smc.certain(Hypothesis(here[None], here, here)),
        keyframe_map=KeyframeMap(pages=pages or PageFile()).with_keyframe(surface),
        keyframe_times_ns=(time_ns,),
        calibration=calibration,
        motion=motion,
        pivot=pivot,
        unseen_step=np.asarray(spread_of_a_step(motion, here, pivot)),
        times_ns=(time_ns, time_ns),
        lost_frames=0,
        steps_were_wide=False,
        rival=RivalMotion.since(surface),
    )
    return state, first_frame_info(config.keyframes_compared)


def info_before_map(state: FilterState, config: SlamConfig) -> FrameInfo:
    """A frame before the first that shows anything: lost, anywhere that the motion prior leads from there.

    Args:
        state: after the first frame that does, by `init`.
        config: settings.
    """
    info = first_frame_info(config.keyframes_compared)
    places = replace(info.places, covariances=state.unseen_step[None])
    return replace(info, places=places, lost=True, explained=0.0, is_keyframe=False)


def first_frame_info(compared: int) -> FrameInfo:
    """The reference itself: certain, and no evidence for or against anything."""
    here = np.asarray(IDENTITY, np.float32)
    places = FoundPlaces(
        anchors=np.zeros(1, np.int32),
        relative_poses=here[None],
        covariances=np.zeros((1, 6, 6), np.float32),
        field_sensitivity=np.zeros((1, 6, NODES), np.float32),
        ties=Ties(
            np.zeros((1, compared), np.int32),
            np.tile(here, (1, compared, 1)),
            np.zeros((1, compared, 6, 6), np.float32),
        ),
        ancestors=np.zeros(1, np.int32),
    )
    return FrameInfo(
        places=places,
        log_evidence=0.0,
        hypotheses=1.0,
        resampled=False,
        lost=False,
        unexpected=False,
        explained=1.0,
        keyframes=1,
        is_keyframe=True,
        doubt=CERTAIN,
    )
