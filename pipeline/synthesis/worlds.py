"""Single images of synthetic worlds like the real ones in which parsing fails.

A small table over a floor, seats and a shelf near by, a room round all of it; objects that nobody asks for
beside those that are asked for, and others asked for that are not there; a sensor whose errors hang together.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.synthesis.colours import muted_colour
from pipeline.synthesis.filming import FIRST_STAMP_NS, clutter_parts, film_along, object_part, true_object
from pipeline.synthesis.furniture import chair, shelf, table
from pipeline.synthesis.paths import PathConfig, camera_path
from pipeline.synthesis.placement import Table, rest_on_table
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.resting import RestingObject
from pipeline.synthesis.rooms import on_floor
from pipeline.synthesis.scenarios import CameraConfig, SyntheticScene
from pipeline.synthesis.sensor import DepthSensor
from pipeline.synthesis.solids import surface_of
from pipeline.synthesis.world import Part
from recordings.settings import check_finite, check_within
from recordings.truth import TABLE
from recordings.types import Trajectory

REAL_CORRELATION = (0.9, 0.7, 0.6)
"""Of residuals 1, 2 and 3 pixels apart on real frames of structured light."""
DRAWS = 20
"""Sets of objects drawn before a world is given up."""
SEAT_GAP_M = (0.15, 0.4)
"""Between the table's edge and a seat."""
SHELF_GAP_M = (0.5, 1.2)
"""Between the table's edge and the shelf behind it."""
SIDE_RAD = np.radians(100.0)
"""Seats stand at most so far round from straight behind the table."""


def real_sensor() -> DepthSensor:
    """A structured-light camera as it errs on real frames."""
    return DepthSensor(
        correlation=REAL_CORRELATION,
        quantisation_m=0.0005,
        quantisation_growth_per_m=0.0012,
        scale_error=0.012,
        dark_none_probability=0.4,
        shine_none_probability=0.3,
    )


@dataclass(frozen=True, kw_only=True)
class WorldScene(SyntheticScene):
    """What a world consists of.

    Attributes:
        objects: that are there and asked for.
        unasked: things of other meshes that nobody asks for.
        clutter: and things of no mesh at all.
        absent: shapes that are asked for and not there.
        table_radius_m: least and largest half width of the table's top.
        table_height_m: least and largest height of it.
        distance_m: least and largest distance of the camera from the table's middle.
        elevation_deg: least and largest angle of the camera above it.
        aim_error_deg: standard deviation of the aim about both image axes: the image cuts the table.
    """

    camera: CameraConfig = field(default_factory=lambda: CameraConfig(width=640, height=480))
    sensor: DepthSensor = field(default_factory=real_sensor)
    objects: int = 4
    unasked: int = 2
    clutter: int = 1
    absent: int = 2
    table_radius_m: tuple[float, float] = (0.22, 0.35)
    table_height_m: tuple[float, float] = (0.4, 0.8)
    distance_m: tuple[float, float] = (0.7, 1.1)
    elevation_deg: tuple[float, float] = (25.0, 55.0)
    aim_error_deg: float = 6.0

    def __post_init__(self) -> None:
        check_finite(self)
        check_within(self, 0.0, 90.0, ("aim_error_deg",))
        if self.objects < 1 or min(self.unasked, self.clutter, self.absent) < 0:
            raise ValueError("objects must be at least 1, unasked, clutter and absent not negative")
        for name in ("table_radius_m", "table_height_m", "distance_m"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise ValueError(f"{name} must be two positive lengths, least first, got {(low, high)}")
        if not -90 < self.elevation_deg[0] <= self.elevation_deg[1] < 90:
            raise ValueError(f"elevation_deg must be two angles in (-90, 90), got {self.elevation_deg}")


@dataclass(frozen=True, kw_only=True, eq=False)
class World:
    """One world on film.

    Attributes:
        recording: of one frame; its truth holds the objects that are asked for and there.
        absent: shapes to be asked for as well.
    """

    recording: SyntheticRecording
    absent: tuple[str, ...]


def film_world(
    shapes: Mapping[str, trimesh.Trimesh],
    others: Mapping[str, trimesh.Trimesh],
    scene: WorldScene,
    seed: int,
) -> World:
    """The world of a seed.

    Args:
        shapes: that may be asked for.
        others: meshes of things that nobody asks for; without any there is clutter alone.
        scene: what it consists of.
        seed: makes the world.

    Raises:
        PipelineError: the objects do not fit on the table.
    """
    rng = np.random.default_rng([seed, 3])
    names = rng.permutation(sorted(shapes)).tolist()
    asked, absent = names[: scene.objects], names[scene.objects : scene.objects + scene.absent]
    support, pile = _pile(shapes, others, asked, scene, rng)
    azimuth = rng.uniform(0, 2 * np.pi)
    target = np.array([0.0, 0.0, support.height_m + 0.05])
    path = PathConfig(
        frames=1,
        radius_m=rng.uniform(*scene.distance_m),
        elevations_deg=(rng.uniform(*scene.elevation_deg),),
        start_deg=float(np.degrees(azimuth)),
        look_at_error_deg=scene.aim_error_deg,
    )
    trajectory = Trajectory(
        times_ns=np.array([FIRST_STAMP_NS]), reference_from_camera=camera_path(path, target, rng)
    )
    width = 2 * support.radius_m
    top = surface_of(table(width, width, support.height_m))
    parts = [object_part(one) for one in pile]
    parts.append(Part(name=TABLE, mesh=top, world_from_part=np.eye(4), colour=muted_colour(rng)))
    parts += clutter_parts(scene.clutter, pile, support, rng)
    parts += _furniture(support.radius_m, azimuth, rng)
    objects = [true_object(one) for one in pile if one.shape in asked]
    recording = film_along(trajectory, scene, parts, objects, support.height_m, rng, int(rng.integers(2**31)))
    return World(recording=recording, absent=tuple(absent))


def _pile(
    shapes: Mapping[str, trimesh.Trimesh],
    others: Mapping[str, trimesh.Trimesh],
    asked: list[str],
    scene: WorldScene,
    rng: np.random.Generator,
) -> tuple[Table, list[RestingObject]]:
    """A table and what rests on it, the asked objects first; smaller tables are given up for larger ones."""
    refused = ""
    for _ in range(DRAWS):
        radius = rng.uniform(*scene.table_radius_m)
        support = Table(height_m=rng.uniform(*scene.table_height_m), radius_m=radius, spread_m=0.45 * radius)
        unasked = rng.permutation(sorted(others)).tolist()[: scene.unasked]
        meshes = [(name, shapes[name]) for name in asked] + [(name, others[name]) for name in unasked]
        try:
            pile = rest_on_table(meshes, support, rng)
        except PipelineError as error:
            refused = str(error)
            continue
        return support, sorted(pile, key=lambda one: one.shape not in asked)
    raise PipelineError(f"no world in {DRAWS} draws: {refused}")


def _furniture(radius_m: float, camera_rad: float, rng: np.random.Generator) -> list[Part]:
    """Two seats and a shelf on the side of the table that the camera does not stand on."""
    pieces = [(chair(rng), SEAT_GAP_M, 0.25), (chair(rng), SEAT_GAP_M, 0.25), (shelf(rng), SHELF_GAP_M, 0.15)]
    parts = []
    for number, (piece, gap, depth) in enumerate(pieces):
        turn = camera_rad + np.pi + rng.uniform(-SIDE_RAD, SIDE_RAD) * (number < 2)
        place = (radius_m * np.sqrt(2) + rng.uniform(*gap) + depth) * _direction(turn)
        pose = on_floor(place, float(turn + np.pi / 2))  # its back is turned away from the table
        name = f"furniture {number}"
        parts.append(Part(name=name, mesh=surface_of(piece), world_from_part=pose, colour=muted_colour(rng)))
    return parts


def _direction(angle_rad: float) -> NDArray[np.float64]:
    return np.array([np.cos(angle_rad), np.sin(angle_rad)])
