"""The committed values of a run, read together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.room import RoomView
from pipeline.run_folder import RunFolder
from pipeline.surfaces import Surfaces
from scene.result import SceneResult
from shapes.prior import ShapePrior
from slam.result import SlamResult


@dataclass(frozen=True, kw_only=True, eq=False)
class RunValues:
    """What a run knows so far.

    Attributes:
        slam: the camera's trajectory.
        room: what was seen along it.
        shapes: learned shapes by name.
        surfaces: of the objects that were looked for.
        scene: which objects stand where.
    """

    slam: SlamResult | None
    room: RoomView | None
    shapes: dict[str, ShapePrior]
    surfaces: Surfaces | None = None
    scene: SceneResult | None = None

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
        """Every committed value of a run."""
        stages = run.stages()
        return cls(
            slam=SlamResult.load(run.value_path("slam")) if "slam" in stages else None,
            room=RoomView.load(run.value_path("room")) if "room" in stages else None,
            shapes={
                name.removeprefix("learn/"): ShapePrior.load(run.value_path(name))
                for name in stages
                if name.startswith("learn/")
            },
            surfaces=Surfaces.load(run.value_path("objects")) if "objects" in stages else None,
            scene=SceneResult.load(run.value_path("parse")) if "parse" in stages else None,
        )
