"""Scenes to film: one object to learn, or a table of objects to parse."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from pipeline.synthesis.paths import PathConfig
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.sensor import DepthSensor
from recordings.settings import check_finite, check_within
from recordings.types import CameraIntrinsics

LARGEST_SIDE_PX = 4096
"""No depth camera has more."""


@dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """Pinhole camera in pixels; unset parameters give square pixels and a centred axis.

    Attributes:
        width: image width.
        height: image height.
        fx: focal length; None gives 60 degrees across the width.
        fy: None is `fx`.
        cx: None is the middle, (width - 1) / 2.
        cy: None is the middle.
    """

    width: int = 320
    height: int = 240
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None

    def __post_init__(self) -> None:
        check_finite(self)
        check_within(self, 1, LARGEST_SIDE_PX, ("width", "height"))

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """The camera with every parameter filled in."""
        fx = self.fx or self.width / 2 / np.tan(np.radians(30.0))
        return CameraIntrinsics(
            width=self.width,
            height=self.height,
            fx=fx,
            fy=self.fy or fx,
            cx=(self.width - 1) / 2 if self.cx is None else self.cx,
            cy=(self.height - 1) / 2 if self.cy is None else self.cy,
        )


@dataclass(frozen=True, kw_only=True)
class SyntheticScene:
    """What every scene has.

    Attributes:
        camera: image size and lens.
        sensor: noise, and what does not return.
        room: what surrounds the scene.
        colours: of objects: `plain` or `painted`, by their names and the same in every film, or `random`.
    """

    camera: CameraConfig = field(default_factory=CameraConfig)
    sensor: DepthSensor = field(default_factory=DepthSensor)
    room: RoomConfig = field(default_factory=RoomConfig)
    colours: Literal["plain", "painted", "random"] = "plain"


@dataclass(frozen=True, kw_only=True)
class FilmedScene(SyntheticScene):
    """A scene round which the camera is led.

    Attributes:
        path: how it moves.
    """

    path: PathConfig = field(default_factory=PathConfig)


@dataclass(frozen=True, kw_only=True)
class ObjectScene(FilmedScene):
    """One object, filmed to be learned.

    Attributes:
        support: the object stands on a `pedestal` in a stable pose, or is `floating` at any attitude.
        height_m: height of the pedestal's top, or of the floating object.
    """

    support: Literal["pedestal", "floating"] = "pedestal"
    height_m: float = 0.9

    def __post_init__(self) -> None:
        check_finite(self)
        if self.height_m <= 0.05:
            raise ValueError(f"height_m must be above 0.05, got {self.height_m}")


@dataclass(frozen=True, kw_only=True)
class TableScene(FilmedScene):
    """Several objects on a table, filmed to be parsed.

    Attributes:
        objects: how many are drawn from the shapes, without repeats while they last.
        stacked_share: at least this share of the objects rest on another object.
        spread_m: standard deviation of the objects' places; smaller hides more behind one another.
        clutter: things on the table that are none of the shapes.
        table_radius_m: half the width of the square table.
        table_height_m: height of its top.
    """

    camera: CameraConfig = field(default_factory=lambda: CameraConfig(width=640, height=480))
    path: PathConfig = field(
        default_factory=lambda: PathConfig(
            kind="handheld", frames=20, degrees_per_frame=2.0, radius_m=0.8, elevations_deg=(40.0,)
        )
    )
    objects: int = 5
    stacked_share: float = 0.0
    spread_m: float = 0.13
    clutter: int = 0
    table_radius_m: float = 0.45
    table_height_m: float = 0.75

    def __post_init__(self) -> None:
        check_finite(self)
        if self.objects < 1 or self.clutter < 0:
            raise ValueError("objects must be at least 1 and clutter not negative")
        if not 0 <= self.stacked_share < 1:
            raise ValueError(f"stacked_share must lie in [0, 1), got {self.stacked_share}")
        if min(self.spread_m, self.table_radius_m, self.table_height_m) <= 0:
            raise ValueError("spread_m, table_radius_m and table_height_m must be positive")
