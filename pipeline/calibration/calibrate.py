"""A sensor's profile from one or more of its recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.calibration.field import MOST_TRACKED, stands_still, tracked_field
from pipeline.calibration.images import SensorImages, spread_evenly
from pipeline.errors import PipelineError
from pipeline.options import Common
from recordings.reading import McapRecording
from recordings.sensor_profile import SensorProfile
from recordings.types import Damage
from slam.config import SlamConfig

if TYPE_CHECKING:
    from shapes.calibration.noise_estimate import NoiseEstimate

LEAST_TRACKED = 5
"""Frames: fewer views tell nothing of a field that all share."""
LOOKED_AT = 5
"""Frames that tell whether a camera moves."""


@dataclass(frozen=True, kw_only=True)
class TrackedRecording:
    """What became of the distortion field in one recording.

    Attributes:
        name: of the recording.
        frames: that were tracked; 0 where the camera stands still or frames are too few.
        lost: of these.
    """

    name: str
    frames: int
    lost: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """A profile, and how well founded it is.

    Attributes:
        profile: all that was learnt.
        estimate: of the noise.
        tracked: what each recording told of the distortion.
        damage: what was lost of each recording.
    """

    profile: SensorProfile
    estimate: NoiseEstimate
    tracked: tuple[TrackedRecording, ...]
    damage: tuple[Damage, ...]


def calibrate(
    recordings: Sequence[tuple[Path, McapRecording]], common: Common, frames: int, *, field: bool
) -> Calibration:
    """The profile of the sensor that took some recordings.

    Args:
        recordings: with their paths.
        common: seed, settings, progress.
        frames: of each recording that noise and the unknown layer are learnt from, at most.
        field: whether the distortion is looked for.

    Raises:
        PipelineError: a recording has no depth, or images of another camera or size.
    """
    first_path, first = recordings[0]
    for path, recording in recordings:
        if recording.intrinsics != first.intrinsics:
            raise PipelineError(
                f"{path} has images of another camera or size than {first_path}; calibrate them apart"
            )
    images = SensorImages.for_others(first.intrinsics)
    moving = [_look_at(path, recording, images, common, frames) for path, recording in recordings]
    with common.progress("calibrate", "") as progress:
        progress.phase("fitting noise and the unknown layer")
        estimate = images.noise()
        profile = images.profile([path.name for path, _ in recordings])
    tracked = []
    for number, ((path, recording), (moves, total)) in enumerate(zip(recordings, moving, strict=True)):
        told = TrackedRecording(name=path.name, frames=0, lost=0)
        if field and moves and total >= LEAST_TRACKED:
            told, profile = _track(number, path, recording, profile, common, min(total, MOST_TRACKED))
        tracked.append(told)
    return Calibration(
        profile=profile,
        estimate=estimate,
        tracked=tuple(tracked),
        damage=tuple(recording.damage for _, recording in recordings),
    )


def _look_at(
    path: Path, recording: McapRecording, images: SensorImages, common: Common, most: int
) -> tuple[bool, int]:
    """Take in frames of a recording; whether its camera moves, and how many frames it has."""
    with common.progress(f"calibrate {path.name}", "frames") as progress:
        progress.phase("reading")
        total = recording.statistics().frames
        numbers = spread_evenly(total, most)
        looked_at, kept = set(spread_evenly(len(numbers), LOOKED_AT)), []
        for place, frame in enumerate(recording.chosen(set(numbers))):
            images.add(frame.depth_m)
            if place in looked_at:
                kept.append(frame.depth_m)
            progress(place + 1, len(numbers))
    if not kept:
        raise PipelineError(f"{path} has no depth frame that can be read")
    return not stands_still(kept, images.noise().noise), total


def _track(
    number: int, path: Path, recording: McapRecording, known: SensorProfile, common: Common, total: int
) -> tuple[TrackedRecording, SensorProfile]:
    import jax

    from pipeline.seeds import stage_key

    config = common.settings.section("slam", SlamConfig)
    key = jax.random.fold_in(stage_key(common.seed, "slam"), number)
    with common.progress(f"calibrate {path.name}", "frames") as progress:
        progress.phase("tracking the camera for the distortion field")
        try:
            result, profile = tracked_field(key, recording, known, config, progress, progress.phase, total)
        except ValueError as error:
            raise PipelineError(f"{path}: {error}") from error
    lost = int(result.lost.sum())
    if 2 * lost > len(result):
        profile = known
    told = TrackedRecording(name=path.name, frames=len(result), lost=lost)
    return told, replace(known, distortion=profile.distortion)
