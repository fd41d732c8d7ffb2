"""Small recordings that the tests of this folder share."""

from pathlib import Path

import numpy as np
import pytest

from recordings.types import CameraIntrinsics, Frame

SECOND_NS = 1_000_000_000


@pytest.fixture
def camera() -> CameraIntrinsics:
    """A small camera with unequal focal lengths and an off-centre principal point."""
    return CameraIntrinsics(width=40, height=30, fx=35.0, fy=36.0, cx=18.5, cy=15.25)


@pytest.fixture
def frames(seed: int, camera: CameraIntrinsics) -> list[Frame]:
    """Twelve frames of whole millimetres with holes, 0.1 s apart."""
    rng = np.random.default_rng(seed)
    shape = camera.height, camera.width
    depths = [rng.integers(300, 4000, shape) * (rng.random(shape) > 0.1) for _ in range(12)]
    return [
        Frame(time_ns=5 * SECOND_NS + i * SECOND_NS // 10, depth_m=(depth / 1000).astype(np.float32))
        for i, depth in enumerate(depths)
    ]


@pytest.fixture
def poses(frames: list[Frame]) -> np.ndarray:
    """A camera path that starts at the identity, (12, 4, 4)."""
    angles = np.linspace(0.0, 0.5, len(frames))
    path = np.tile(np.eye(4), (len(frames), 1, 1))
    path[:, 0, 0] = path[:, 2, 2] = np.cos(angles)
    path[:, 0, 2], path[:, 2, 0] = np.sin(angles), -np.sin(angles)
    path[:, :3, 3] = np.outer(angles, [0.3, -0.1, 0.2])
    return path


@pytest.fixture
def recording_path(tmp_path: Path) -> Path:
    """Where a test writes its recording."""
    return tmp_path / "recording.mcap"
