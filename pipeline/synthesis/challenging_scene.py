"""How challenging images are taken: what a user may set about them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from pipeline.errors import PipelineError
from pipeline.synthesis.challenging_kinds import KINDS
from pipeline.synthesis.placement import Table
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import CameraConfig, SyntheticScene
from pipeline.synthesis.sensor import DepthSensor
from recordings.settings import check_finite, check_within
from recordings.types import DepthNoise

DEPTH_UNIT_M = 0.0001
"""Of a stored 1, as in YCB-Video."""
MOST_STORED = 65534
"""Of 16 bits; 65535 reads as saturated."""


@dataclass(frozen=True, kw_only=True)
class ChallengingScene(SyntheticScene):
    """How the images are taken.

    Attributes:
        distance_m: least and largest distance of the camera from the target.
        elevation_deg: least and largest angle of the camera above the target's horizon.
        aim_error_deg: standard deviation of the aim about both image axes.
        visible: limits of the target's visible fraction inside those of its kind; none where empty.
        clutter: things on the table that are none of the shapes.
        spread_m: standard deviation of the objects' places on the table.
        table_radius_m: half the width of the square table.
        table_height_m: height of its top.
    """

    camera: CameraConfig = field(default_factory=lambda: CameraConfig(width=640, height=480))
    sensor: DepthSensor = field(
        default_factory=lambda: DepthSensor(
            quantisation_m=DEPTH_UNIT_M, noise=DepthNoise(max_range_m=MOST_STORED * DEPTH_UNIT_M)
        )
    )
    room: RoomConfig = field(default_factory=lambda: RoomConfig(kind="none"))
    distance_m: tuple[float, float] = (0.6, 1.1)
    elevation_deg: tuple[float, float] = (15.0, 65.0)
    aim_error_deg: float = 3.0
    visible: tuple[float, ...] = ()
    clutter: int = 0
    spread_m: float = 0.06
    table_radius_m: float = 0.45
    table_height_m: float = 0.75

    def __post_init__(self) -> None:
        check_finite(self)
        check_within(self, 0.0, 90.0, ("aim_error_deg",))
        if not 0 < self.distance_m[0] <= self.distance_m[1]:
            raise ValueError(
                f"distance_m must be two positive distances, nearest first, got {self.distance_m}"
            )
        if not -90 < self.elevation_deg[0] <= self.elevation_deg[1] < 90:
            raise ValueError(f"elevation_deg must be two angles in (-90, 90), got {self.elevation_deg}")
        if self.visible and not (len(self.visible) == 2 and 0 <= self.visible[0] < self.visible[1] <= 1):
            raise ValueError(f"visible must be two shares in [0, 1], lowest first, got {self.visible}")
        if min(self.spread_m, self.table_radius_m, self.table_height_m) <= 0 or self.clutter < 0:
            raise ValueError("spread_m and the table's sizes must be positive, clutter not negative")

    def seen_worse(self, noise: float, size: tuple[int, int]) -> ChallengingScene:
        """The same with so many times the sensor's standard deviation, and images of another size."""
        usual = self.sensor.noise
        worse = replace(
            usual,
            sigma_base_m=noise * usual.sigma_base_m,
            sigma_growth_per_m=noise * usual.sigma_growth_per_m,
        )
        camera = CameraConfig(width=size[0], height=size[1])
        return replace(self, sensor=replace(self.sensor, noise=worse), camera=camera)

    @property
    def support(self) -> Table:
        """The table."""
        return Table(height_m=self.table_height_m, radius_m=self.table_radius_m, spread_m=self.spread_m)

    def limits(self, kind: str) -> tuple[float, float]:
        """Least and largest visible fraction of that kind's target.

        Raises:
            PipelineError: what is asked for lies outside the kind's own limits.
        """
        low, high = KINDS[kind]
        if self.visible:
            low, high = max(low, self.visible[0]), min(high, self.visible[1])
        if low >= high:
            asked = ":".join(f"{share:g}" for share in self.visible)
            raise PipelineError(
                f"--visible {asked} leaves nothing of {kind} images, which show {KINDS[kind][0]:g} to"
                f" {KINDS[kind][1]:g} of their target"
            )
        return low, high
