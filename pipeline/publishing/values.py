"""The committed values of a run, read together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.publishing.finite import drawable_path, drawable_scene
from pipeline.room import RoomView
from pipeline.run_folder import RunFolder
from pipeline.stored_profile import StoredProfile
from pipeline.surfaces import Surfaces
from recordings.sensor_profile import SensorProfile
from scene.result import SceneResult
from shapes.prior import ShapePrior
from slam.result import SlamResult

V = TypeVar("V")
LEVEL = 0.02
"""Mean squared sine (8 degrees) between the image's x axes and a direction across them, at most."""
UPRIGHT = float(np.cos(np.radians(45)))
"""A plane that leans more is a wall, or a grid that was laid along the camera's axes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RunValues:
    """What a run knows so far.

    Attributes:
        sensor: what is known of the sensor, but for what `slam` learnt of its distortion.
        slam: the camera's trajectory.
        room: what was seen along it.
        shapes: learned shapes by name.
        surfaces: of the objects that were looked for.
        scene: which objects stand where.
        warnings: what was to be said of each stage's input.
    """

    slam: SlamResult | None
    room: RoomView | None
    shapes: dict[str, ShapePrior]
    surfaces: Surfaces | None = None
    scene: SceneResult | None = None
    sensor: StoredProfile | None = None
    warnings: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def profile(self) -> SensorProfile | None:
        """All that is known of the sensor; None where the run knows nothing, or numbers of no sensor."""
        tracked = None
        if self.slam is not None:
            with suppress(ValueError, OverflowError):
                tracked = self.slam.sensor
        if self.sensor is None or tracked is None:
            return tracked if self.sensor is None else self.sensor.profile
        return replace(self.sensor.profile, distortion=tracked.distortion)

    @property
    def reference_from_parsed(self) -> NDArray[np.float64]:
        """Pose (4, 4) of the first frame that was parsed, whose camera the scene's objects are in."""
        if self.scene is None or self.slam is None:
            return np.eye(4)
        return self.slam.mean[self.scene.frames[0]]

    @property
    def parsed_time_ns(self) -> int | None:
        """Stamp of that frame, as far as the run knows it."""
        if self.scene is None:
            return None
        first = int(self.scene.frames[0])
        if self.slam is not None:
            return int(self.slam.times_ns[first])
        if self.room is not None and first in self.room.frames:
            return int(self.room.times_ns[self.room.frames == first][0])
        return None

    @property
    def up(self) -> NDArray[np.float64]:
        """Unit vector (3,) in the reference frame: a learned support's normal, else what cameras hold level.

        People hold cameras so that the image's x axis is level: up is across all of them, on the side where
        the images have their top. A shape's grid stands on its support, or is not upright at all.
        """
        level = self._level_up
        supports = [shape.reference_from_grid[:3, 2] for shape in self.shapes.values()]
        return next((normal for normal in supports if normal @ level > UPRIGHT), level)

    @property
    def _level_up(self) -> NDArray[np.float64]:
        """Across the x axes of all cameras."""
        if self.slam is None:
            return np.array([0.0, -1.0, 0.0])
        rightward, top = self.slam.mean[:, :3, 0], -self.slam.mean[:, :3, 1].mean(axis=0)
        tilt, axes = np.linalg.eigh(rightward.T @ rightward / len(rightward))
        across = axes[:, tilt < LEVEL]
        up = across @ (across.T @ top) if across.size else top
        return up / max(float(np.linalg.norm(up)), 1e-12)

    @property
    def camera_frame(self) -> str:
        """The recording's name of the frame that its depth images are in."""
        return "camera" if self.room is None else str(self.room.frame_id)

    @property
    def camera_frame_has_parent(self) -> bool:
        """Whether the recording itself says where that frame is."""
        return self.room is not None and bool(self.room.frame_has_parent)

    @property
    def frame_from_camera(self) -> NDArray[np.float64]:
        """The camera (4, 4), which looks along z, in that frame."""
        return np.eye(4) if self.room is None else self.room.frame_from_camera

    def stamped_poses(self) -> list[tuple[int, NDArray[np.float64]]]:
        """Stamps and reference_from_camera (4, 4) of every frame whose pose is known."""
        if self.slam is not None:
            return list(zip(self.slam.times_ns.tolist(), self.slam.mean, strict=True))
        if self.room is not None:
            return [(int(self.room.times_ns[0]), np.eye(4))]
        return []

    @property
    def first_ns(self) -> int:
        """Stamp of the first of them; 0 without."""
        return next((time_ns for time_ns, _ in self.stamped_poses()), 0)

    @classmethod
    def load(cls, run: RunFolder) -> RunValues:
        """Every committed value of a run.

        Raises:
            PipelineError: a value was written by another version of the program.
        """
        records = run.records()
        paths = [run.value_path(name) for name in records]
        values = cls.of_files({path.relative_to(run.path).as_posix(): path for path in paths})
        warnings = {name: record.notes.get("warnings", ()) for name, record in records.items()}
        return replace(values, warnings=warnings)

    @classmethod
    def of_files(cls, files: Mapping[str, Path]) -> RunValues:
        """The values in files, by their names within a run folder.

        Raises:
            PipelineError: a value was written by another version of the program.
        """
        learned = {name: path for name, path in files.items() if name.startswith("shapes/")}
        shapes = {PurePosixPath(name).stem: _read(ShapePrior.load, path) for name, path in learned.items()}
        return cls(
            slam=_read(SlamResult.load, files.get("slam.npz")),
            room=_read(RoomView.load, files.get("room.npz")),
            shapes={name: shape for name, shape in shapes.items() if shape is not None},
            surfaces=_read(Surfaces.load, files.get("objects.npz")),
            scene=_read(SceneResult.load, files.get("parse.npz")),
            sensor=_read(StoredProfile.load, files.get("stages/sensor.toml")),
        )

    @property
    def drawable(self) -> RunValues:
        """The same with poses that every view and format can take: what is not finite counts as lost."""
        return replace(
            self,
            slam=None if self.slam is None else drawable_path(self.slam),
            scene=None if self.scene is None else drawable_scene(self.scene),
        )


def _read(load: Callable[[Path], V], path: Path | None) -> V | None:
    if path is None:
        return None
    try:
        return load(path)
    except ValueError as error:
        raise PipelineError(f"{error}; make it again: the same command with --force") from error
