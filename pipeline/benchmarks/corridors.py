"""A corridor round a block of rooms: a camera that walks all of it comes back, one that stops does not."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from pipeline.benchmarks.slam_cases import Case, Row, filmed
from pipeline.synthesis.colours import muted_colour
from pipeline.synthesis.paths import level_rotations
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.scenarios import CameraConfig
from pipeline.synthesis.sensor import DepthSensor
from pipeline.synthesis.solids import block, surface_of, union
from pipeline.synthesis.world import Part

WIDTH_M, HEIGHT_M, WALL_M = 1.8, 2.4, 0.1
EYE_M, PITCH_RAD = 1.4, 0.35
"""Height of the camera, and how far it looks down: a robot's."""
TURN_RADIUS_M = 0.9
"""About the corner of the inner wall."""
STEP_M, STEP_NS = 0.1, 100_000_000
"""From frame to frame: a metre a second."""
OVERRUN_M = 1.0
"""Beyond the start, where the camera sees what it saw there."""
OPEN_SHARE = 0.7
"""Of the way round, walked where it is not to come back: all of three sides."""
PIECES_PER_M = 3.0
"""Cupboards, boxes and door frames along both walls."""
PIECE_DEPTH_M = (0.05, 0.4)
FIELD_OF_VIEW_DEG = 70.0
DISTORTION_PER_M = 1.5e-3
"""Standard deviation of the field of the sensors that have one: the 7-Scenes kitchen's."""


def corridor_rows(length_m: float) -> list[Row]:
    """Judged where the camera ends: at its start again, where a loop can be closed, or on the third side.

    Args:
        length_m: once round, its corners not cut.
    """
    return [
        Row(
            name=f"corridor of {length_m:.0f} m, {way}{sensor}",
            case=partial(corridor, length_m, returns=returns, distortion_per_m=distortion),
            judged_by="end",
        )
        for sensor, distortion in (("", 0.0), (", distorted", DISTORTION_PER_M))
        for way, returns in (("all round", True), ("three sides", False))
    ]


def corridor(length_m: float, number: int, *, returns: bool, distortion_per_m: float = 0.0) -> Case:
    """Frames of 160 x 120 along a square way of that length, room and things of that number.

    The camera's distortion field, of that standard deviation, is drawn for each number, too.
    """
    rng = np.random.default_rng([number, 77_004])
    side = length_m / 4.0
    walked = length_m + OVERRUN_M if returns else OPEN_SHARE * length_m
    poses = _path(side, np.arange(0.0, walked, STEP_M))
    camera = CameraConfig(width=160, height=120, fx=80.0 / np.tan(np.radians(FIELD_OF_VIEW_DEG / 2)))
    sensor = DepthSensor(distortion_per_m=distortion_per_m)
    return filmed(
        SyntheticRecording.of_surroundings(
            _parts(side, rng), poses, camera.intrinsics, sensor, number, STEP_NS
        )
    )


def _path(side_m: float, walked_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (T, 4, 4) on a square round the origin, its corners rounded, from the middle of a side."""
    straight, quarter = side_m - 2 * TURN_RADIUS_M, 0.5 * np.pi * TURN_RADIUS_M
    lap = straight + quarter
    shifted = walked_m * 4 * lap / (4 * side_m) + straight / 2
    number, along = np.divmod(shifted, lap)
    ahead, turned = np.minimum(along, straight), np.maximum(along - straight, 0.0) / TURN_RADIUS_M
    x = ahead - straight / 2 + TURN_RADIUS_M * np.sin(turned)
    y = -side_m / 2 + TURN_RADIUS_M * (1.0 - np.cos(turned))
    heading = number * np.pi / 2 + turned
    cosine, sine = np.cos(number * np.pi / 2), np.sin(number * np.pi / 2)
    poses = np.tile(np.eye(4), (len(walked_m), 1, 1))
    poses[:, 0, 3], poses[:, 1, 3], poses[:, 2, 3] = cosine * x - sine * y, sine * x + cosine * y, EYE_M
    poses[:, :3, :3] = level_rotations(heading, PITCH_RAD)
    return poses


def _parts(side_m: float, rng: np.random.Generator) -> list[Part]:
    """Floor, ceiling, both walls and the things along them, none in the way of another side."""
    outer, inner = side_m + WIDTH_M, side_m - WIDTH_M
    slab = block(outer, outer, WALL_M)
    shell = union(
        slab.translate((0, 0, -WALL_M)),
        slab.translate((0, 0, HEIGHT_M)),
        block(outer + 2 * WALL_M, outer + 2 * WALL_M, HEIGHT_M) - block(outer, outer, HEIGHT_M),
        block(inner, inner, HEIGHT_M),
    )
    pieces = [shell]
    for _ in range(int(4 * side_m * PIECES_PER_M)):
        depth, width = rng.uniform(*PIECE_DEPTH_M), rng.uniform(0.2, 1.0)
        high, low = rng.uniform(0.4, HEIGHT_M), rng.choice([0.0, rng.uniform(0.0, 1.2)])
        wall = rng.choice([-1.0, 1.0])
        along = (side_m - wall * WIDTH_M - width) / 2 * rng.uniform(-1.0, 1.0)
        across = -side_m / 2 + wall * (WIDTH_M / 2 - depth / 2)
        piece = block(width, depth, min(high, HEIGHT_M - low), x=along, y=across, z=low)
        pieces.append(piece.rotate((0.0, 0.0, 90.0 * rng.integers(4))))
    return [
        Part(
            name=f"corridor {index}",
            mesh=surface_of(piece),
            world_from_part=np.eye(4),
            colour=muted_colour(rng),
        )
        for index, piece in enumerate(pieces)
    ]
