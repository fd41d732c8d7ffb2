"""The stage `sensor`: what the run knows of its sensor, given by the user or learnt from the recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.errors import PipelineError
from pipeline.run_folder import Committed
from pipeline.stored_profile import StoredProfile

if TYPE_CHECKING:
    from pipeline.session import Session

SOURCES = (
    "pipeline.stages.sensor",
    "pipeline.calibration.images",
    "shapes.calibration.noise_estimate",
    "scene.likelihood.unknown_surfaces",
    "scene.observation.pixel_window",
)


def sensor_stage(session: Session) -> Committed[StoredProfile]:
    """What is known of the session's sensor.

    Raises:
        PipelineError: the recording has no depth frame.
    """
    return session.stage("sensor", StoredProfile.load, lambda: _learned(session), {}, sources=SOURCES)


def _learned(session: Session) -> StoredProfile:
    from pipeline.calibration.images import profile_of

    with session.common.progress("sensor", "frames") as progress:
        progress.phase("reading")
        total = session.look().frames
        progress.phase("learning the sensor")
        try:
            return StoredProfile(profile_of(session.recording, total, progress))
        except ValueError as error:
            raise PipelineError(f"{session.source.path}: {error}") from error
