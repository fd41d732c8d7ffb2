"""What moves before a camera at rest, or along with one that moves: depth of a thing over that of a room.

The thing is there from the first frame on, so that the map cannot know it from the room.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pipeline.benchmarks.slam_cases import TARGET_M, Case, Row, filmed_in_furnished_room
from pipeline.synthesis.paths import PathConfig, camera_path
from pipeline.synthesis.sensor import DepthSensor
from recordings.types import NO_RETURN, Frame

CROSSING_SHARES = (0.2, 0.4, 0.55, 0.8)
ATTACHED_SHARES = (0.15, 0.5)
FRAMES = 8
CROSSES = (0.38, 0.62)
"""Shares of the image's width between which the middle of the thing goes."""
DEGREES_PER_FRAME, RADIUS_M, ELEVATION_DEG = 2.0, (1.2, 1.8), (0.0, 30.0)
DISTANCE_M = (0.8, 1.3)
RELIEF_M, RIPPLE_M = 0.15, 0.03
"""How far the thing bulges towards the camera, and folds in it."""
BODY_M = (0.5, 0.9)
"""Distances of a robot's own body at the lower edge of the image and at the upper edge of the body."""
SIGMA_M, SIGMA_GROWTH_PER_M = 0.0012, 0.0019
"""The sensor's noise (Khoshelham and Elberink 2012), drawn for the thing as it is for the room."""


def moving_rows() -> list[Row]:
    """A row for each share of the view."""
    crossings = [
        Row(name=f"moving: {share:.0%} crosses, camera at rest", case=partial(crossing, share))
        for share in CROSSING_SHARES
    ]
    bodies = [
        Row(name=f"moving: {share:.0%} fixed to the camera", case=partial(attached, share))
        for share in ATTACHED_SHARES
    ]
    return [*crossings, *bodies]


def crossing(share: float, number: int) -> Case:
    """A camera at rest, and a thing that covers that share of its view on its way across."""
    rng = np.random.default_rng([number, 77_003])
    room = _room(rng, number, moves=False)
    rows, columns = room.frames[0].depth_m.shape
    height = min(0.9, 1.4 * np.sqrt(share)) * rows
    width = 0.25 * np.pi * height / rows
    half = np.array([share / width * columns / 2.0, height / 2.0])
    distance = rng.uniform(*DISTANCE_M)
    middles = np.linspace(*CROSSES, FRAMES) * columns
    frames = [
        _with_thing(frame, _bulging(rows, columns, middle, half, distance), rng)
        for frame, middle in zip(room.frames, middles, strict=True)
    ]
    return replace(room, frames=frames)


def attached(share: float, number: int) -> Case:
    """A hand-held camera of whose view the lower part, of that share, is fixed to it."""
    rng = np.random.default_rng([number, 77_004])
    room = _room(rng, number, moves=True)
    rows, columns = room.frames[0].depth_m.shape
    v, u = np.mgrid[0:rows, 0:columns]
    down = (v / rows - (1.0 - share)) / share
    near, far = BODY_M
    body = far - (far - near) * down + RIPPLE_M * np.sin(u / 10.0)
    body = np.where(down > 0, body, np.inf)
    return replace(room, frames=[_with_thing(frame, body, rng) for frame in room.frames])


def _room(rng: np.random.Generator, number: int, *, moves: bool) -> Case:
    """A furnished room before a camera that is hand-held or at rest."""
    path = PathConfig(
        kind="handheld",
        frames=FRAMES,
        degrees_per_frame=DEGREES_PER_FRAME,
        radius_m=rng.uniform(*RADIUS_M),
        elevations_deg=(rng.uniform(*ELEVATION_DEG),),
    )
    poses = camera_path(path, TARGET_M, rng)
    if not moves:
        poses = np.repeat(poses[:1], FRAMES, axis=0)
    return filmed_in_furnished_room(poses, path.radius_m, DepthSensor(), rng, number)


def _bulging(
    rows: int, columns: int, middle: float, half: NDArray[np.float64], distance: float
) -> NDArray[np.float64]:
    """Depth (rows, columns) of a rippled ellipsoid, infinite beside it."""
    v, u = np.mgrid[0:rows, 0:columns]
    across, down = (u - middle) / half[0], (v - 0.55 * rows) / half[1]
    inside = np.clip(1.0 - across**2 - down**2, 0.0, None)
    ripple = RIPPLE_M * np.sin((u - middle) / 6.0) * np.cos(v / 8.0)
    return np.where(inside > 0, distance - RELIEF_M * np.sqrt(inside) + ripple, np.inf)


def _with_thing(frame: Frame, thing_m: NDArray[np.float64], rng: np.random.Generator) -> Frame:
    """The frame with a thing before it wherever that is nearer."""
    sigma = SIGMA_M + SIGMA_GROWTH_PER_M * (np.where(np.isfinite(thing_m), thing_m, 0.4) - 0.4) ** 2
    noisy = thing_m + sigma * rng.normal(size=thing_m.shape)
    nearer = np.isfinite(thing_m) & ((frame.depth_m == NO_RETURN) | (thing_m < frame.depth_m))
    return replace(frame, depth_m=np.where(nearer, noisy, frame.depth_m).astype(np.float32))
