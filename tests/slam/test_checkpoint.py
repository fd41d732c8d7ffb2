"""A tracker that was killed goes on from its checkpoint with the same numbers."""

from dataclasses import fields
from pathlib import Path

import jax
import numpy as np
import pytest

from recordings.types import Frame
from slam import history
from slam.checkpoint import Checkpoint
from slam.config import SlamConfig
from slam.keyframes.pages import PageFile
from slam.keyframes.surfels import SurfelImage
from slam.pose_graph import growing_map
from slam.pose_graph.overlaps import KeyframeDetail
from slam.result import SlamResult
from slam.tracking import track
from tests.slam import box_room


def walk_after_a_blank(count: int, seed: int) -> list[Frame]:
    """Views of a room by a camera that moves; the first shows nothing."""
    frames = box_room.frames(box_room.walk(count), seed=seed)
    frames[0] = Frame(time_ns=frames[0].time_ns, depth_m=np.zeros_like(frames[0].depth_m))
    return frames


def same(one: SlamResult, other: SlamResult) -> bool:
    """Whether two results hold the same bits."""
    return all(
        np.asarray(getattr(one, field.name)).tobytes() == np.asarray(getattr(other, field.name)).tobytes()
        for field in fields(one)
    )


@pytest.mark.parametrize("killed_after", [pytest.param(2, marks=pytest.mark.slow), 5])
def test_a_killed_tracker_ends_with_the_same_bytes(
    key: jax.Array, seed: int, tmp_path: Path, killed_after: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Through a file; frames before it are not tracked again. The map is refined after each keyframe."""
    monkeypatch.setattr(growing_map, "REFINED_EVERY", 1)
    frames = walk_after_a_blank(7, seed)
    config = SlamConfig(particles=16)
    whole = track(jax.random.clone(key), frames, box_room.INTRINSICS, config)
    pages = PageFile()

    def kill(checkpoint: Checkpoint) -> None:
        if len(checkpoint.history) == killed_after:
            checkpoint.save(tmp_path / "checkpoint")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        track(jax.random.clone(key), frames, box_room.INTRINSICS, config, pages=pages, on_checkpoint=kill)
    seen: list[int] = []
    resumed = track(
        jax.random.clone(key),
        frames,
        box_room.INTRINSICS,
        config,
        on_frame=lambda info: seen.append(info.keyframes),
        pages=pages,
        checkpoint=Checkpoint.load(tmp_path / "checkpoint", pages),
    )

    assert len(seen) == len(frames)
    assert seen[-1] > 1
    assert same(resumed, whole)


def test_what_leaves_memory_changes_nothing(
    key: jax.Array, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With room for one keyframe, and blocks of three frames, the same bytes."""
    frames, config = walk_after_a_blank(7, seed), SlamConfig(particles=16)
    whole = track(jax.random.clone(key), frames, box_room.INTRINSICS, config)
    pages = PageFile()
    for kind in (SurfelImage, KeyframeDetail):
        monkeypatch.setattr(kind, "ROOM", 1)
    monkeypatch.setattr(history, "FRAMES_AT_ONCE", 3)

    assert same(track(jax.random.clone(key), frames, box_room.INTRINSICS, config, pages=pages), whole)
    assert pages.size > 0


def test_a_checkpoint_without_its_pages_is_refused(key: jax.Array, seed: int, tmp_path: Path) -> None:
    """As where half of the file was lost."""
    frames, pages = walk_after_a_blank(3, seed), PageFile()

    def keep(checkpoint: Checkpoint) -> None:
        checkpoint.save(tmp_path / "checkpoint")

    track(key, frames, box_room.INTRINSICS, SlamConfig(particles=16), pages=pages, on_checkpoint=keep)

    with pytest.raises(ValueError, match="pages"):
        Checkpoint.load(tmp_path / "checkpoint", PageFile())


@pytest.mark.parametrize("content", [b"", b"PK", b"no archive"])
def test_a_damaged_checkpoint_is_refused(tmp_path: Path, content: bytes) -> None:
    """As one that is no checkpoint at all."""
    (tmp_path / "checkpoint").write_bytes(content)
    with pytest.raises(ValueError, match="checkpoint"):
        Checkpoint.load(tmp_path / "checkpoint", PageFile())


def test_a_checkpoint_builds_nothing_but_this_programs_dataclasses(tmp_path: Path) -> None:
    """Whatever its file says."""
    for kind in ("subprocess:Popen", "slam.tracking:track", "slam.nothing:X"):
        shape = f'{{"kind": "{kind}", "fields": {{}}}}'
        with (tmp_path / "checkpoint").open("wb") as file:
            np.savez(file, shape=np.array(shape))
        with pytest.raises(ValueError, match="no checkpoint"):
            Checkpoint.load(tmp_path / "checkpoint", PageFile())
