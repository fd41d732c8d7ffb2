"""The distortion field of a sensor, from recordings in which its camera moves."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from recordings.sensor_profile import SensorProfile
from recordings.types import NO_RETURN, DepthNoise, Frame
from shapes.depth_noise import standard_deviation

if TYPE_CHECKING:
    import jax

    from recordings.reading import McapRecording
    from slam.config import SlamConfig
    from slam.result import SlamResult

MOST_TRACKED = 400
"""Frames of a recording that are tracked, from its first one on: some twenty keyframes of a kitchen."""
STILL = 3.0
"""Median difference of two images of a camera at rest, in standard deviations of the sensor, at most."""


def stands_still(depths_m: Sequence[NDArray[np.float32]], noise: DepthNoise) -> bool:
    """Whether images (H, W) all show the same, up to noise."""
    first = depths_m[0]
    for other in depths_m[1:]:
        both = (first != NO_RETURN) & (other != NO_RETURN)
        if both.any():
            sigma_m = standard_deviation(noise, first[both])
            if np.median(np.abs(other[both] - first[both]) / sigma_m) > STILL:
                return False
    return True


def tracked_field(
    key: jax.Array,
    recording: McapRecording,
    known: SensorProfile,
    config: SlamConfig,
    on_frame: Callable[[int, int], None],
    on_phase: Callable[[str], None],
    total: int,
) -> tuple[SlamResult, SensorProfile]:
    """The camera's way through a recording, and the profile with what that tells of the distortion.

    Args:
        key: consumed.
        recording: the frames.
        known: of the sensor so far; its field is the prior, by which frames are corrected.
        config: of tracking.
        on_frame: called with frames done and in all.
        on_phase: called with what is done after the last frame.
        total: frames that are tracked.

    Raises:
        ValueError: no frame shows anything.
    """
    from slam.tracking import track

    done = itertools.count(1)
    field = replace(known, noise=None, unknown=None, correlation=None)
    result = track(
        key,
        corrected_frames(itertools.islice(recording, total), known),
        recording.intrinsics,
        config,
        lambda _: on_frame(next(done), total),
        on_phase=on_phase,
        sensor=None if known.distortion is None else field,
    )
    return result, replace(known, distortion=result.sensor.distortion)


def corrected_frames(frames: Iterable[Frame], known: SensorProfile) -> Iterator[Frame]:
    """The frames without the distortion, as far as it is known."""
    return (replace(frame, depth_m=known.corrected(frame.depth_m)) for frame in frames)
