"""The committed values of a run, read together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.publishing.finite import drawable_path, drawable_scene
from pipeline.room import RoomView
from pipeline.run_folder import RunFolder
from pipeline.surfaces import Surfaces
from scene.result import SceneResult
from shapes.prior import ShapePrior
from slam.result import SlamResult

V = TypeVar("V")


@dataclass(frozen=True, kw_only=True, eq=False)
class RunValues:
    """What a run knows so far.

    Attributes:
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
    warnings: Mapping[str, Sequence[str]] = field(default_factory=dict)

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

    @classmethod
    def load(cls, run: RunFolder) -> RunValues:
        """Every committed value of a run.

        Raises:
            PipelineError: a value was written by another version of the program.
        """
        stages = run.records()
        slam = _read(SlamResult.load, run, "slam") if "slam" in stages else None
        room = _read(RoomView.load, run, "room") if "room" in stages else None
        learned = [name for name in stages if name.startswith("learn/")]
        shapes = {name.removeprefix("learn/"): _read(ShapePrior.load, run, name) for name in learned}
        surfaces = _read(Surfaces.load, run, "objects") if "objects" in stages else None
        scene = _read(SceneResult.load, run, "parse") if "parse" in stages else None
        warnings = {name: record.notes.get("warnings", ()) for name, record in stages.items()}
        return cls(slam=slam, room=room, shapes=shapes, surfaces=surfaces, scene=scene, warnings=warnings)

    @property
    def drawable(self) -> RunValues:
        """The same with poses that every view and format can take: what is not finite counts as lost."""
        return replace(
            self,
            slam=None if self.slam is None else drawable_path(self.slam),
            scene=None if self.scene is None else drawable_scene(self.scene),
        )


def _read(load: Callable[[Path], V], run: RunFolder, stage: str) -> V:
    try:
        return load(run.value_path(stage))
    except ValueError as error:
        raise PipelineError(f"{error}; make it again: the same command with --force") from error
