"""The stage `slam`: where the camera was, in every frame."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.checkpoints import CheckpointKeeper
from pipeline.errors import PipelineError
from pipeline.memory import give_back_free_memory
from pipeline.run_folder import Committed
from pipeline.session import Session
from pipeline.stages.room import room_stage
from pipeline.stages.sensor import sensor_stage
from slam.config import SlamConfig

if TYPE_CHECKING:
    from slam.filter.state import FrameInfo
    from slam.result import SlamResult

SOURCES = ("pipeline.stages.slam", "slam.tracking")
MANY_SEARCHED = 10
FRAMES_UNTIL_TIDY, TIDIED_AT = 1000, 100
"""By the hundredth frame most kernels are compiled."""
MOSTLY_LOST = 0.5
"""Share of frames without a place from which a run is no whole path. Chosen by hand."""
TOLD_DISPLACEMENT_M = 0.02
"""By which a second motion must widen the told spread of a frame to be worth a warning. Chosen by hand."""
MANY_CONTESTED = 5
"""Such frames that are worth the warning: of one kitchen at rest, read at five rates, four at most had a
second motion by mistake. Chosen by that recording alone."""
CAUSES = (
    "tracking is slow and doubtful there: is it the right unit (--depth-scale), camera and depth topic, do "
    "few frames a second leave out much of the way, does something large move, is there but a bare wall?"
)
"""Why so many frames in a row find no place near the one before."""


def slam_stage(session: Session, options: Mapping[str, Any] | None = None) -> Committed[SlamResult]:
    """The camera's trajectory in the session's recording.

    Args:
        session: the recording and the run folder.
        options: what the command's own options say, by key of `SlamConfig`.

    Raises:
        PipelineError: the recording has no depth frame with a return, or none but the first was found; or
            the run holds a stage of other frames.
    """
    session.begin("slam", "sensor")
    config = session.common.settings.section("slam", SlamConfig, options)

    def tracked() -> SlamResult:
        result = _track(session, config)
        _tell_lost(session, result)
        return result

    trajectory = session.stage("slam", _load, tracked, {"slam": config}, sources=SOURCES)
    room_stage(session, trajectory)
    sensor_stage(session)
    return trajectory


def _tell_lost(session: Session, result: SlamResult) -> None:
    """Say where most frames were not found.

    Raises:
        PipelineError: none but the first was.
    """
    if len(result) > 1 and result.lost[1:].all():
        raise PipelineError(
            f"{session.source.path}: no frame but the first was found; is it the right unit "
            "(--depth-scale), camera (--intrinsics) and depth topic, and is there more than a flat wall?"
        )
    if result.lost.mean() > MOSTLY_LOST:
        session.warn(f"{int(result.lost.sum())} of {len(result)} frames are lost: this is no whole path")


def _load(path: Path) -> SlamResult:
    from slam.result import SlamResult

    return SlamResult.load(path)


def _track(session: Session, config: SlamConfig) -> SlamResult:
    from slam.checkpoint import Checkpoint
    from slam.keyframes.pages import PageFile
    from slam.tracking import track

    assert session.run.checkpoint_path is not None  # while the stage is computed
    keeper = CheckpointKeeper(session.run.checkpoint_path)
    recording, key = session.recording, session.key("slam")
    with keeper.pages() as file, session.common.progress("slam", "frames") as progress:
        pages = PageFile(file)
        progress.phase("reading")
        total, done, searched = session.look().frames, 0, 0
        contested: list[int] = []
        progress.phase(f"compiling once for {recording.size[0]}x{recording.size[1]}")

        def on_frame(info: FrameInfo) -> None:
            nonlocal done, searched
            done += 1
            searched = searched + 1 if info.unexpected else 0
            if searched == MANY_SEARCHED:
                session.warn(
                    f"frames {done - searched} to {done - 1} had to be searched one by one; {CAUSES}"
                )
            if info.doubt.shift_m > TOLD_DISPLACEMENT_M:
                contested.append(done - 1)
            progress(done, total)
            if done % FRAMES_UNTIL_TIDY == TIDIED_AT:
                give_back_free_memory()

        try:
            result = track(
                key,
                recording,
                recording.intrinsics,
                config,
                on_frame,
                on_phase=progress.phase,
                sensor=recording.sensor,
                pages=pages,
                checkpoint=keeper.found(partial(Checkpoint.load, pages=pages)),
                on_checkpoint=keeper.keep,
            )
        except ValueError as error:
            lost = f"; {recording.problems[0]}" if recording.problems else ""
            raise PipelineError(f"{session.source.path}: {error}{lost}") from error
        if len(contested) >= MANY_CONTESTED:
            session.warn(
                f"in {len(contested)} frames, {contested[0]} to {contested[-1]}, two things move against "
                "each other and which is the room is open: the reported uncertainty reaches to both. What "
                "moves along with the camera is left out by --mask FILE.png"
            )
        return result
