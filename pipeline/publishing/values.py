"""The committed values of a run, read together."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.room import RoomView
from pipeline.run_folder import RunFolder
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
        scene: which objects stand where.
    """

    slam: SlamResult | None
    room: RoomView | None
    shapes: dict[str, ShapePrior]
    scene: SceneResult | None = None

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
            scene=SceneResult.load(run.value_path("parse")) if "parse" in stages else None,
        )
