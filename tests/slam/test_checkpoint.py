"""A tracker that was killed goes on from its checkpoint with the same numbers."""

from dataclasses import fields
from pathlib import Path

import jax
import numpy as np
import pytest

from recordings.types import CameraIntrinsics, Frame
from slam.checkpoint import Checkpoint
from slam.config import SlamConfig
from slam.result import SlamResult
from slam.tracking import track

CAMERA = CameraIntrinsics(width=96, height=72, fx=84.0, fy=84.0, cx=47.5, cy=35.5)


def corner_of_a_room(count: int, rng: np.random.Generator) -> list[Frame]:
    """Views of three walls by a camera that moves a centimetre a frame; the first shows nothing."""
    rays = CAMERA.rays(np.arange(96)[None], np.arange(72)[:, None])
    normals, offsets = np.array([[0.6, 0, 0.8], [-0.8, 0, 0.6], [0, 1.0, 0]]), np.array([2.0, 1.6, 1.1])
    frames = []
    for number in range(count):
        with np.errstate(divide="ignore"):
            distances = (offsets - normals @ [0.01 * number, 0, 0]) / (rays @ normals.T)
        depth = np.where(distances > 0, distances, np.inf).min(axis=-1)
        depth += rng.normal(0, 0.002, depth.shape)
        depth_m = (depth if number else 0 * depth).astype(np.float32)
        frames.append(Frame(time_ns=number * 33_000_000, depth_m=depth_m))
    return frames


def same(one: SlamResult, other: SlamResult) -> bool:
    """Whether two results hold the same bits."""
    return all(
        np.asarray(getattr(one, field.name)).tobytes() == np.asarray(getattr(other, field.name)).tobytes()
        for field in fields(one)
    )


@pytest.mark.parametrize("killed_after", [pytest.param(2, marks=pytest.mark.slow), 7])
def test_a_killed_tracker_ends_with_the_same_bytes(
    key: jax.Array, seed: int, tmp_path: Path, killed_after: int
) -> None:
    """Through a file; frames before the checkpoint are not tracked again."""
    frames = corner_of_a_room(10, np.random.default_rng(seed))
    config = SlamConfig(particles=16)
    whole = track(jax.random.clone(key), frames, CAMERA, config)

    def kill(checkpoint: Checkpoint) -> None:
        if len(checkpoint.history.frames) == killed_after:
            checkpoint.save(tmp_path / "checkpoint")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        track(jax.random.clone(key), frames, CAMERA, config, on_checkpoint=kill)
    seen: list[int] = []
    resumed = track(
        jax.random.clone(key),
        frames,
        CAMERA,
        config,
        on_frame=lambda info: seen.append(info.keyframes),
        checkpoint=Checkpoint.load(tmp_path / "checkpoint"),
    )

    assert len(seen) == len(frames)
    assert same(resumed, whole)


@pytest.mark.parametrize("content", [b"", b"PK", b"no archive"])
def test_a_damaged_checkpoint_is_refused(tmp_path: Path, content: bytes) -> None:
    """As one that is no checkpoint at all."""
    (tmp_path / "checkpoint").write_bytes(content)
    with pytest.raises(ValueError, match="checkpoint"):
        Checkpoint.load(tmp_path / "checkpoint")


def test_a_checkpoint_builds_nothing_but_this_programs_dataclasses(tmp_path: Path) -> None:
    """Whatever its file says."""
    for kind in ("subprocess:Popen", "slam.tracking:track", "slam.nothing:X"):
        shape = f'{{"kind": "{kind}", "fields": {{}}}}'
        with (tmp_path / "checkpoint").open("wb") as file:
            np.savez(file, shape=np.array(shape))
        with pytest.raises(ValueError, match="no checkpoint"):
            Checkpoint.load(tmp_path / "checkpoint")
