"""The Python interface of voxscene, which programs import as `voxscene`.

    import voxscene

    recording = voxscene.open_recording("kitchen.mcap", every=2)
    trajectory = voxscene.track(recording)
    shape = voxscene.learn(recording, trajectory)
    scene = voxscene.parse(recording, "meshes", objects=("mug", "can"))

Metres, radians, nanoseconds; poses are 4x4 matrices named target_from_source; camera frames look along +z
with x to the right and y down. Equal inputs and seeds give the results of the command line. Compiled
kernels are kept in the user's cache folder. Everything else in the packages may change without notice.
"""

from __future__ import annotations

import warnings
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pipeline.errors import ConfigError, PipelineError
from pipeline.seeds import stage_key
from recordings.errors import RecordingError
from recordings.options import ReadOptions
from recordings.reading import McapRecording
from recordings.types import CameraIntrinsics, Frame, Trajectory
from scene.config import ParseConfig
from scene.result import SceneResult
from shapes.learning.config import LearnConfig
from shapes.prior import ShapePrior
from slam.config import SlamConfig
from slam.result import SlamResult

Config = TypeVar("Config", ReadOptions, SlamConfig, LearnConfig, ParseConfig)

__all__ = [
    "CameraIntrinsics",
    "ConfigError",
    "Frame",
    "LearnConfig",
    "McapRecording",
    "ParseConfig",
    "PipelineError",
    "ReadOptions",
    "RecordingError",
    "SceneResult",
    "ShapePrior",
    "SlamConfig",
    "SlamResult",
    "Trajectory",
    "learn",
    "open_recording",
    "parse",
    "recorded_trajectory",
    "track",
]


def open_recording(path: str | Path, **options: Any) -> McapRecording:
    """The depth frames of an MCAP file or a rosbag2 folder; no file stays open between iterations.

    Args:
        path: the file or folder.
        options: fields of `ReadOptions`, such as depth_topic, every, start_s.

    Raises:
        RecordingError: it cannot be read, has no depth, or its camera is unknown.
        ValueError: an option cannot be used.
    """
    from recordings.reading import open_recording as opened

    return opened(Path(path), _configured(ReadOptions, "recording", options))


def recorded_trajectory(path: str | Path, **options: Any) -> Trajectory | None:
    """The poses that a recording brings of its camera, for comparison; None where it brings none.

    Raises:
        RecordingError: it cannot be read, or several pose topics could be meant.
    """
    from recordings.poses.recorded import recorded_trajectory as recorded

    return recorded(Path(path), _configured(ReadOptions, "recording", options))


def track(recording: McapRecording, *, seed: int = 0, **settings: Any) -> SlamResult:
    """Where the camera was in every frame, and how surely.

    Args:
        recording: the frames.
        seed: root of all randomness.
        settings: fields of `SlamConfig`.

    Raises:
        ValueError: no frame has a return, or a setting cannot be used.
    """
    from slam.tracking import track as tracked

    _prepare()
    return tracked(
        stage_key(seed, "slam"),
        recording,
        recording.intrinsics,
        _configured(SlamConfig, "slam", settings),
        sensor=recording.sensor,
    )


def learn(recording: McapRecording, trajectory: SlamResult, *, seed: int = 0, **settings: Any) -> ShapePrior:
    """The shape of the object that the recording looks at, voxel by voxel.

    Args:
        recording: the frames.
        trajectory: of its camera, from `track`.
        seed: root of all randomness.
        settings: fields of `LearnConfig`.

    Raises:
        ValueError: there is no object to learn, or a setting cannot be used.
        PipelineError: every frame is lost, or the trajectory is of other frames.
    """
    from pipeline.stages.learn import tracked_frames
    from shapes.learning.distillation import learn_shape

    _check_trajectory(trajectory, recording)
    _prepare()
    config = _configured(LearnConfig, "learn", settings)
    config = config.with_noise(recording.sensor and recording.sensor.noise)
    posed = tracked_frames(trajectory)
    stamps = set(posed.times_ns.tolist())
    return learn_shape(
        stage_key(seed, "learn"),
        (frame for frame in recording if frame.time_ns in stamps),
        recording.intrinsics,
        posed.trajectories,
        posed.log_weights,
        config.for_tracked_poses,
    )


def parse(
    recording: McapRecording,
    shapes: str | Path,
    *,
    trajectory: SlamResult | None = None,
    seed: int = 0,
    **settings: Any,
) -> SceneResult:
    """Which objects stand where in the recording, what rests on what, and how sure that is.

    Args:
        recording: the frames.
        shapes: folder of learned shapes, a run that holds some, or meshes in metres.
        trajectory: of its camera, from `track`; needed where `frames` names several.
        seed: root of all randomness.
        settings: fields of `ParseConfig`, such as objects and frames.

    Raises:
        PipelineError: a shape or frame is missing, has no colours where they are compared, or, where several
            are named, is lost or not of the trajectory.
        ValueError: the frames show nothing to parse, or a setting cannot be used.
    """
    from pipeline.calibration.images import profile_of
    from pipeline.shape_folder import chosen, load_surfaces
    from pipeline.stages.parse import parse_recording, relative_poses
    from pipeline.surfaces import Surfaces

    _prepare()
    config = _configured(ParseConfig, "parse", settings)
    if config.colour == "only":
        raise ValueError("colour 'only' is the command line's: voxscene parse --colour only")
    if len(config.frames) > 1 and trajectory is None:
        raise ValueError("several frames need a trajectory: give that of `track`")
    poses = np.eye(4)[None]
    if len(config.frames) > 1 and trajectory is not None:
        _check_trajectory(trajectory, recording)
        poses = relative_poses(trajectory, config.frames)
    surfaces = Surfaces(chosen(load_surfaces(Path(shapes)), config.objects))
    sensor = profile_of(recording, recording.statistics().frames)
    keys = stage_key(seed, "parse"), stage_key(seed, "draws")
    return parse_recording(keys, recording, Path(shapes), surfaces, poses, sensor, config, warnings.warn)


def _configured(kind: type[Config], name: str, settings: dict[str, Any]) -> Config:
    """Settings of the kind that a settings file's section of this name has, with its rules.

    Raises:
        TypeError: there is no setting of a name.
        ValueError: a value cannot be used.
    """
    from pipeline.config import build

    if unknown := settings.keys() - {field.name for field in fields(kind)}:
        raise TypeError(f"there is no setting {name}.{min(unknown)}")
    try:
        return build(kind, _plain(settings), name)
    except ConfigError as error:
        raise ValueError(str(error)) from error


def _plain(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings of plain values and tuples of them, as settings files give them, for NumPy's and for lists."""
    values = {
        name: value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        for name, value in settings.items()
    }
    return {
        name: tuple(value) if isinstance(value, list | range) else value for name, value in values.items()
    }


def _check_trajectory(trajectory: SlamResult, recording: McapRecording) -> None:
    """Refuse the trajectory of another recording, or of other frames."""
    if not set(trajectory.times_ns.tolist()).issubset(recording.stamps_ns()):
        raise PipelineError(
            "the trajectory is of other frames: open the recording with the options that `track` had"
        )


def _prepare() -> None:
    """Set JAX up as the commands do."""
    from pipeline.jax_setup import set_up_jax

    set_up_jax()
