"""What the joint refinement makes of a real recording: drift of its keyframes, and its distortion elsewhere.

Neither is judged by a reference trajectory, which hand-held recordings know to centimetres only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from pipeline.benchmarks.slam_cases import Case
from pipeline.calibration.field import corrected_frames
from pipeline.progress import Report
from recordings.distortion_field import NODE_COLUMNS, NODE_ROWS, PRIOR_SD_PER_M
from recordings.errors import RecordingError
from recordings.sensor_profile import SensorProfile
from recordings.types import NO_RETURN, CameraIntrinsics, DepthNoise, Frame
from shapes.geometry.camera import Camera, pixel_rays
from shapes.geometry.poses import matrices_of, poses_of, transform_points
from slam.checkpoint import Checkpoint
from slam.config import SlamConfig
from slam.pose_graph.distortion_scale import SCALES
from slam.pose_graph.overlaps import KeyframeImages
from slam.pose_graph.refinement import MapMixture, refine_keyframes
from slam.result import SlamResult
from slam.tracking import track

DRIFT_ROW = "real: redkitchen, with drift"
HALVES_ROW = "real: redkitchen, by halves"
DRIFT_M = 0.03
"""From keyframe to keyframe."""
COMPARED_FRAMES, COMPARED_PIXELS = 10, 4
"""Frames of a half between which depths are compared, and every so many-th row and column of them."""
LARGEST_GAP_M = 0.1
"""A larger one is another surface."""


def drift_row(case: Callable[[int], Case], seed: int, report: Report) -> dict[str, Any]:
    """Refinement from keyframes that drift, at random and in one direction, against that from the filter's.

    Args:
        case: the recording, by a number of which 0 alone is used.
        seed: of the drift.
        report: is told how many of how many optima are found.
    """
    try:
        images, maps = _keyframes(case(0))
    except RecordingError as error:
        return {"row": DRIFT_ROW, "skipped": str(error)}
    rng, count = np.random.default_rng(seed), maps.poses.shape[1]
    optimum = _positions(images, maps)
    runs = []
    for done, steps in enumerate([_directions(rng, count), np.tile(_directions(rng, 1), (count, 1))]):
        report(done + 1, 3)
        drift_m = np.cumsum(DRIFT_M * steps, axis=0) - DRIFT_M * steps[0]
        moved = matrices_of(maps.poses[0])
        moved[:, :3, 3] += drift_m
        drifted = replace(maps, poses=poses_of(moved)[None].astype(np.float32))
        away_m = np.linalg.norm(_positions(images, drifted) - optimum, axis=1)
        runs.append({"put_in_m": float(np.linalg.norm(drift_m, axis=1).max()), "left_m": float(away_m.max())})
    report(3, 3)
    return {"row": DRIFT_ROW, "keyframes": count, "drift": runs}


def _directions(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """So many random unit vectors (count, 3)."""
    drawn = rng.normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def _keyframes(case: Case) -> tuple[KeyframeImages, MapMixture]:
    """All keyframes after the last frame, and the filter's likeliest map."""
    last: list[Checkpoint] = []

    def keep(one: Checkpoint) -> None:
        last[:] = [one]

    track(jax.random.key(0), case.frames, case.intrinsics, SlamConfig(), on_checkpoint=keep)
    state = last[0].state
    maps = MapMixture.of(state.population)
    best = int(np.argmax(maps.probabilities))
    likeliest = MapMixture(
        poses=maps.poses[best][None],
        probabilities=np.ones(1),
        hypotheses=np.zeros(1, int),
        known=(maps.known[best],),
    )
    return KeyframeImages.of(state, last[0].details, DepthNoise()), likeliest


def _positions(images: KeyframeImages, maps: MapMixture) -> NDArray[np.float64]:
    """Of the refined keyframes (N, 3)."""
    sd = np.full((NODE_ROWS, NODE_COLUMNS), PRIOR_SD_PER_M)
    refined = refine_keyframes(jax.random.key(0), images, maps, 1, sd, scales=SCALES)
    return matrices_of(refined.poses[0])[:, :3, 3]


def halves_row(case: Callable[[int], Case], report: Report) -> dict[str, Any]:
    """By how much overlapping frames of each half disagree, as measured and corrected by the other's field.

    Corrected frames are tracked anew.

    Args:
        case: the recording, by a number of which 0 alone is used.
        report: is told how many of how many trajectories are found.
    """
    try:
        whole = case(0)
    except RecordingError as error:
        return {"row": HALVES_ROW, "skipped": str(error)}
    middle = len(whole.frames) // 2
    halves = [whole.frames[:middle], whole.frames[middle:]]
    measured = []
    for done, frames in enumerate(halves):
        measured.append(_tracked(frames, whole.intrinsics, None))
        report(done + 1, 4)
    rows = []
    for used, (frames, result, other) in enumerate(zip(halves, measured, measured[::-1], strict=True)):
        learned = other.sensor
        corrected = list(corrected_frames(frames, learned))
        again = _tracked(corrected, whole.intrinsics, learned)
        before, after = (
            frame_gaps(images, found.mean, whole.intrinsics)
            for images, found in ((frames, result), (corrected, again))
        )
        rows.append(
            {
                "rms_m": float(np.sqrt((before**2).mean())),
                "rms_corrected_m": float(np.sqrt((after**2).mean())),
                "median_m": float(np.median(before)),
                "median_corrected_m": float(np.median(after)),
            }
        )
        report(used + 3, 4)
    return {"row": HALVES_ROW, "frames": middle, "halves": rows}


def _tracked(
    frames: Sequence[Frame], intrinsics: CameraIntrinsics, sensor: SensorProfile | None
) -> SlamResult:
    return track(jax.random.key(0), frames, intrinsics, SlamConfig(), sensor=sensor)


def frame_gaps(
    frames: Sequence[Frame], reference_from_camera: NDArray[np.float64], intrinsics: CameraIntrinsics
) -> NDArray[np.float64]:
    """Absolute differences (n,), in metres, between depths of frames and of others' points seen from there.

    Args:
        frames: T, of which ten are compared.
        reference_from_camera: (T, 4, 4).
        intrinsics: of the frames.
    """
    chosen = np.unique(np.linspace(0, len(frames) - 1, COMPARED_FRAMES).astype(int))
    camera = Camera.from_intrinsics(intrinsics)
    rays = np.asarray(pixel_rays(camera, intrinsics.height, intrinsics.width), np.float64)

    def of_pairs() -> Iterator[NDArray[np.float64]]:
        for first, second in combinations(chosen.tolist(), 2):
            sampled_m = frames[first].depth_m[::COMPARED_PIXELS, ::COMPARED_PIXELS]
            points = (rays[::COMPARED_PIXELS, ::COMPARED_PIXELS] * sampled_m[..., None])[
                sampled_m != NO_RETURN
            ]
            second_from_first = np.linalg.inv(reference_from_camera[second]) @ reference_from_camera[first]
            seen = transform_points(second_from_first, points)
            seen = seen[seen[:, 2] > 0]
            pixels = seen[:, :2] / seen[:, 2:] * [intrinsics.fx, intrinsics.fy] + [
                intrinsics.cx,
                intrinsics.cy,
            ]
            column, row = np.round(pixels).astype(int).T
            inside = (column >= 0) & (column < intrinsics.width) & (row >= 0) & (row < intrinsics.height)
            depth_m = frames[second].depth_m[row[inside], column[inside]]
            gaps = np.abs(depth_m - seen[inside, 2])[depth_m != NO_RETURN]
            yield gaps[gaps < LARGEST_GAP_M]

    return np.concatenate(list(of_pairs()))
