"""A flat of twenty rooms, filmed for an hour: a camera looks about in each and comes back to the first."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from pipeline.synthesis.colours import muted_colour
from pipeline.synthesis.furniture import wall_piece
from pipeline.synthesis.paths import level_rotations
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.scenarios import CameraConfig
from pipeline.synthesis.sensor import DepthSensor
from pipeline.synthesis.solids import block, surface_of, union
from pipeline.synthesis.world import Part

COLUMNS, ROWS = 5, 4
"""Of rooms; as many rows as are even, so that a round of all rooms closes."""
ROOM_M, HEIGHT_M, WALL_M = 4.4, 2.5, 0.1
"""A room with its walls."""
DOOR_M, DOOR_HEIGHT_M = 1.0, 2.05
PIECES, PIECES_TRIED = 9, 60
"""Pieces of furniture along the walls of a room."""
EYE_M, EYE_SWAY_M = 1.35, 0.2
BACK_M = 0.5
"""Behind the middle of a room, from where the camera looks about."""
TURN_RAD, WALK_M = np.radians(1.0), 0.025
"""From frame to frame."""
SMOOTHED_FRAMES = 10.0
"""Of the path: nobody stops at once."""
FIELD_OF_VIEW_DEG = 70.0


def flat_film(frames: int, number: int) -> SyntheticRecording:
    """So many frames of 160 x 120, once through all rooms of the flat of that number, back to the first."""
    rng = np.random.default_rng([number, 77_005])
    camera = CameraConfig(width=160, height=120, fx=80.0 / np.tan(np.radians(FIELD_OF_VIEW_DEG / 2)))
    parts = _parts(rng)
    return SyntheticRecording.of_surroundings(
        parts, _path(frames, rng), camera.intrinsics, DepthSensor(), number
    )


def _round() -> NDArray[np.int_]:
    """Rooms (R, 2), each beside the one before, the last beside the first."""
    rooms = [(column, 0) for column in range(COLUMNS)]
    for row in range(1, ROWS):
        columns = range(1, COLUMNS)
        rooms += [(column, row) for column in (columns if row % 2 == 0 else reversed(columns))]
    return np.asarray(rooms + [(0, row) for row in range(ROWS - 1, 0, -1)])


def _path(frames: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Poses world_from_camera (T, 4, 4), z up: whole turns in each room, then through the door that is next.

    Turned at about `TURN_RAD` a frame, walked at about `WALK_M`; more frames are more turns.
    """
    middles = ROOM_M * _round().astype(float)
    ways = np.roll(middles, -1, axis=0) - middles
    headings = np.arctan2(ways[:, 1], ways[:, 0])
    walks = [int(ROOM_M / WALK_M)] * len(middles) + [0]
    stays = np.diff(np.linspace(0, frames, len(middles) + 2).astype(int))
    heading, yaws, positions = headings[-1], [], []
    for room, (stay, walk) in enumerate(zip(stays, walks, strict=True)):
        middle, way = middles[room % len(middles)], headings[room % len(middles)]
        about = max(stay - walk, 2)
        change = (way - heading + np.pi) % (2 * np.pi) - np.pi
        whole_turns = 2 * np.pi * round(TURN_RAD * about / (2 * np.pi))
        turned = heading + np.linspace(0, 1, about) * (change + whole_turns)
        direction = np.stack([np.cos(turned), np.sin(turned)], axis=1)
        ahead = np.linspace(0, ROOM_M, stay - about + 1)[1:, None] * direction[-1]
        yaws.append(np.append(turned, np.full(stay - about, turned[-1])))
        positions += [middle - BACK_M * direction, middle - BACK_M * direction[-1] + ahead]
        heading = turned[-1]
    yaw, place = np.concatenate(yaws), np.concatenate(positions)
    times = np.arange(len(yaw))
    sway, nod = (np.sin(times / period + rng.uniform(0, 6)) for period in (170.0, 230.0))
    yaw, place = (gaussian_filter1d(one, SMOOTHED_FRAMES, axis=0, mode="nearest") for one in (yaw, place))
    pitch = np.radians(18.0) + np.radians(14.0) * nod
    poses = np.tile(np.eye(4), (len(yaw), 1, 1))
    poses[:, :3, :3] = level_rotations(yaw, pitch)
    poses[:, :2, 3], poses[:, 2, 3] = place, EYE_M + EYE_SWAY_M * sway
    return poses


def _parts(rng: np.random.Generator) -> list[Part]:
    """Walls with doors, and furniture along them that leaves the doors free."""
    rooms = ROOM_M * _round().astype(float)
    inner = ROOM_M - WALL_M
    extent = ROOM_M * np.array([COLUMNS, ROWS]) + WALL_M
    centre = ROOM_M * (np.array([COLUMNS, ROWS]) - 1) / 2
    solid = block(extent[0], extent[1], HEIGHT_M + 2 * WALL_M, centre[0], centre[1], -WALL_M)
    hollow = [block(inner, inner, HEIGHT_M, x, y) for x, y in rooms]
    ways = np.roll(rooms, -1, axis=0) - rooms
    for middle, way in zip(rooms, ways, strict=True):
        width, depth = np.where(np.abs(way) > 0, 2 * WALL_M, DOOR_M)
        x, y = middle + way / 2
        hollow.append(block(width, depth, DOOR_HEIGHT_M, x, y))
    pieces = [solid - union(*hollow)]
    for room, middle in enumerate(rooms):
        doors = [ways[room] / ROOM_M, -ways[room - 1] / ROOM_M]
        pieces += [piece.translate((*middle, 0.0)) for piece in _furniture(doors, inner, rng)]
    return [
        Part(
            name=f"flat {index}", mesh=surface_of(piece), world_from_part=np.eye(4), colour=muted_colour(rng)
        )
        for index, piece in enumerate(pieces)
    ]


def _furniture(doors: list[NDArray[np.float64]], side_m: float, rng: np.random.Generator) -> list[Manifold]:
    """Pieces round the middle of a room, whose doors are in these directions (2,)."""
    taken = [_box(1.2 * door, 0.55) for door in doors] + [_box(1.7 * door, 0.55) for door in doors]
    taken.append(_box(np.zeros(2), 0.9))
    chosen: list[Manifold] = []
    for _ in range(PIECES_TRIED):
        piece = wall_piece(rng)
        low, high = np.reshape(piece.bounding_box(), (2, 3))[:, :2]
        along = (side_m - (high[0] - low[0])) / 2 * rng.uniform(-1, 1) - (low[0] + high[0]) / 2
        placed = piece.translate((along, -side_m / 2 - low[1], 0.0)).rotate((0, 0, 90.0 * rng.integers(4)))
        box = np.reshape(placed.bounding_box(), (2, 3))[:, :2]
        if len(chosen) < PIECES and not any(
            (box[0] < other[1]).all() and (other[0] < box[1]).all() for other in taken
        ):
            taken.append(box)
            chosen.append(placed)
    return chosen


def _box(middle: NDArray[np.float64], half_m: float) -> NDArray[np.float64]:
    return np.stack([middle - half_m, middle + half_m])
