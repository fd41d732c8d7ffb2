"""Rooms surround the camera and leave it room."""

import numpy as np
import pytest
import trimesh

from pipeline.synthesis.rooms import RoomConfig, room_parts
from pipeline.synthesis.world import RayCaster

CLEAR_M = 1.2


def caster(kind: str, seed: int = 0, **settings: object) -> RayCaster:
    """Rays into a room of that kind."""
    config = RoomConfig(kind=kind, **settings)  # type: ignore[arg-type]
    return RayCaster(room_parts(config, CLEAR_M, np.random.default_rng(seed)))


def level_rays(count: int) -> np.ndarray:
    """Level directions (count, 3) all round."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=-1)


@pytest.mark.parametrize("kind", ["bare", "furnished", "cluttered", "curved"])
@pytest.mark.parametrize("seed", range(3))
def test_nothing_stands_in_the_clear_circle(kind: str, seed: int) -> None:
    """Rays from the axis at any height travel at least its radius."""
    room = caster(kind, seed)
    for height_m in (0.1, 0.5, 1.0, 1.7, 2.4):
        assert (room.cast(np.array([0, 0, height_m]), level_rays(360)).distance > CLEAR_M).all()


@pytest.mark.parametrize("kind", ["bare", "furnished", "cluttered", "curved"])
def test_a_closed_room_returns_every_ray(kind: str) -> None:
    """In every direction."""
    directions = trimesh.creation.icosphere(4).vertices

    assert np.isfinite(caster(kind).cast(np.array([0.0, 0.0, 1.0]), directions).distance).all()


@pytest.mark.parametrize("kind", ["bare", "curved"])
def test_open_sides_let_rays_out(kind: str) -> None:
    """More with each side."""
    escaped = [
        np.isinf(
            caster(kind, open_sides=sides).cast(np.array([0.0, 0.0, 1.0]), level_rays(720)).distance
        ).mean()
        for sides in range(5)
    ]

    assert escaped[0] == 0
    assert escaped[4] > 0.6
    assert (np.diff(escaped) > 0.1).all()


def test_furniture_fills_a_furnished_room_and_clutter_a_cluttered_one() -> None:
    """Several pieces on average, and more of them in clutter."""
    pieces = {
        kind: np.mean([len(caster(kind, seed).parts) for seed in range(5)])
        for kind in ("furnished", "cluttered")
    }

    assert pieces["furnished"] > 8
    assert pieces["cluttered"] > pieces["furnished"] + 10


def test_no_room_at_all() -> None:
    """Kind `none` is empty."""
    assert room_parts(RoomConfig(kind="none"), CLEAR_M, np.random.default_rng(0)) == []
