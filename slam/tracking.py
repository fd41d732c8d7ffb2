"""Camera tracking: every frame of a recording through the filter, in memory that grows with the map alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import jax
import numpy as np
from numpy.typing import NDArray

from recordings.distortion_field import NODE_COLUMNS, NODE_ROWS, PRIOR_SD_PER_M
from recordings.sensor_profile import SensorProfile
from recordings.types import CameraIntrinsics, DepthNoise, Frame
from slam.checkpoint import Checkpoint
from slam.config import SlamConfig
from slam.filter.init import info_before_map, init
from slam.filter.state import FilterState, FrameInfo
from slam.filter.step import step
from slam.history import History
from slam.keyframes.depth_view import FINE_CANVAS, LEAST_RETURNS, CanvasView, shows_enough, view_of_frame
from slam.keyframes.pages import Paged, PageFile
from slam.map_hypotheses.mode_jump import are_sparse_views, choose_map
from slam.odometry import KissOdometry
from slam.pose_graph.distortion_scale import SCALES
from slam.pose_graph.growing_map import is_due, refined_so_far
from slam.pose_graph.overlaps import KeyframeDetail, KeyframeImages, keyframe_detail
from slam.pose_graph.refinement import refine_keyframes
from slam.pose_graph.trajectory_prior import TrajectoryPrior
from slam.result import SlamResult
from slam.smoothing import smoothed

OnFrame = Callable[[FrameInfo], None]
OnPhase = Callable[[str], None]
OnCheckpoint = Callable[[Checkpoint], None]


def track(
    key: jax.Array,
    frames: Iterable[Frame],
    intrinsics: CameraIntrinsics,
    config: SlamConfig,
    on_frame: OnFrame | None = None,
    *,
    on_phase: OnPhase | None = None,
    sensor: SensorProfile | None = None,
    pages: PageFile | None = None,
    checkpoint: Checkpoint | None = None,
    on_checkpoint: OnCheckpoint | None = None,
) -> SlamResult:
    """Where the camera was in every frame, and how surely.

    The reference is the first frame's camera; where the first frames show nothing they are lost, and taken to
    stand where the first one stood that does.

    Args:
        key: seeds everything; the key of frame t is folded from it, so equal inputs give equal bytes.
        frames: in the order of time.
        intrinsics: of the recording; frames of another size are taken as resized.
        config: settings.
        on_frame: called after every frame.
        on_phase: called with what is done next: loops that are closed, and what follows the last frame.
        sensor: what is known of it: its noise, and the distortion by which the frames have been corrected, of
            which only what it leaves open is unknown then.
        pages: where keyframes and frames go that are not asked for, so that memory hardly grows; None keeps
            them in memory.
        checkpoint: how far a tracker of the same frames, key, settings and pages came that was ended early.
        on_checkpoint: called after every frame with how far this one came.

    Raises:
        ValueError: there is no frame, or none that a map can begin with.
    """
    pages = pages or PageFile()
    if sensor is not None and config.noise is None:
        config = replace(config, noise=sensor.noise)
    tracker = _Tracker(key, config, pages, checkpoint, on_phase or (lambda _: None))
    known = len(tracker.history)
    for info in tracker.history.infos():
        _tell(on_frame, info)
    odometry = None if config.proposal == "enumerate" else KissOdometry(intrinsics)
    for index, (frame, view) in enumerate(_views_ahead(frames, intrinsics)):
        motion = odometry.register(frame) if odometry else None
        if index < known:
            continue
        for info in tracker.follow(index, frame, view, motion, intrinsics):
            _tell(on_frame, info)
        if on_checkpoint is not None and tracker.state is not None:
            on_checkpoint(Checkpoint(state=tracker.state, history=tracker.history, details=tracker.details))
    return tracker.result(intrinsics, sensor)


def _tell(on_frame: OnFrame | None, info: FrameInfo) -> None:
    if on_frame is not None:
        on_frame(info)


class _Tracker:
    """What the frames so far have left behind."""

    def __init__(
        self,
        key: jax.Array,
        config: SlamConfig,
        pages: PageFile,
        checkpoint: Checkpoint | None,
        on_phase: OnPhase,
    ) -> None:
        self.key, self.config, self.pages, self.on_phase = key, config, pages, on_phase
        self.state: FilterState | None = checkpoint.state if checkpoint else None
        self.history = checkpoint.history if checkpoint else History(pages=pages)
        self.details: list[Paged[KeyframeDetail]] = list(checkpoint.details) if checkpoint else []
        self.noise = config.noise or DepthNoise()
        self.waiting: list[int] = []

    def follow(
        self,
        index: int,
        frame: Frame,
        view: CanvasView,
        motion: NDArray[np.float64] | None,
        intrinsics: CameraIntrinsics,
    ) -> list[FrameInfo]:
        """One frame more, by its number; reports of it and of those that waited."""
        config, state, told = self.config, self.state, []
        if state is None and not shows_enough(view):
            self.waiting.append(frame.time_ns)
            return []
        if state is None:
            state, info = init(view, frame.time_ns, config, self.pages)
            told = [info_before_map(state, config) for _ in self.waiting]
        else:
            frame_key = jax.random.fold_in(self.key, index)
            state, info = step(frame_key, state, view, frame.time_ns, config, motion)
        for time_ns, unseen in zip([*self.waiting, frame.time_ns], [*told, info], strict=True):
            self.history.append(time_ns, unseen)
        self.waiting = []
        if info.is_keyframe:
            detailed = view_of_frame(frame, intrinsics, FINE_CANVAS)
            self.details.append(self.pages.hold(keyframe_detail(detailed, self.noise)))
            if is_due(state):
                images = KeyframeImages.of(state, self.details, self.noise)
                state = refined_so_far(state, images, self.on_phase)
        self.state = state
        return [*told, info]

    def result(self, intrinsics: CameraIntrinsics, sensor: SensorProfile | None) -> SlamResult:
        """After the last frame.

        Raises:
            ValueError: there was no frame, or none that a map can begin with.
        """
        state, history, config = self.state, self.history, self.config
        if state is None and not self.waiting:
            raise ValueError("the recording has no depth frame")
        if state is None:
            raise ValueError(
                f"no depth frame has a return in more than {LEAST_RETURNS:.0%} of its pixels;"
                " is it the right depth topic, scale and range?"
            )
        keys = jax.random.split(jax.random.fold_in(self.key, len(history)), 3)
        prior: TrajectoryPrior | None = None
        if are_sparse_views(state, len(history), history.in_doubt):
            self.on_phase("searching for maps of few views")
            prior = TrajectoryPrior.of(state, config)
            self.details = [
                self.pages.hold(detail.value.with_plane_segments(self.noise)) for detail in self.details
            ]
        images = KeyframeImages.of(state, self.details, self.noise)
        maps = choose_map(keys[0], state, config, images, prior)
        self.on_phase("refining the map")
        sd, scales = np.full((NODE_ROWS, NODE_COLUMNS), PRIOR_SD_PER_M), SCALES
        field = sensor.distortion if sensor else None
        if field is not None:
            sd, scales = field.sd_per_m, (1.0,)
        placed = refine_keyframes(keys[1], images, maps, config.particles, sd, prior, scales)
        result = smoothed(keys[2], history, maps, placed, intrinsics)
        if field is None:
            return result
        return replace(result, disparity_per_m=field.disparity_per_m + result.disparity_per_m)


def _views_ahead(frames: Iterable[Frame], intrinsics: CameraIntrinsics) -> Iterator[tuple[Frame, CanvasView]]:
    """Frames with their views; the next one is read and decoded while the present one is tracked."""
    remaining = iter(frames)

    def fetch() -> tuple[Frame, CanvasView] | None:
        frame = next(remaining, None)
        return None if frame is None else (frame, view_of_frame(frame, intrinsics))

    with ThreadPoolExecutor(1) as reader:
        ahead = reader.submit(fetch)
        while (current := ahead.result()) is not None:
            ahead = reader.submit(fetch)
            yield current
