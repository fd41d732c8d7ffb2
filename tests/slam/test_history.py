"""Reports of frames, block by block."""

from dataclasses import replace

import jax
import numpy as np

from slam import history
from slam.filter.rival_motion import CERTAIN
from slam.filter.state import FoundPlaces, FrameInfo, Ties
from slam.history import History

NODES = 63


def _info(rng: np.random.Generator, number: int, ancestors: list[int]) -> FrameInfo:
    count = len(ancestors)
    return FrameInfo(
        places=FoundPlaces(
            anchors=np.full(count, number, np.int32),
            relative_poses=rng.normal(size=(count, 7)).astype(np.float32),
            covariances=rng.normal(size=(count, 6, 6)).astype(np.float32),
            field_sensitivity=np.zeros((count, 6, NODES), np.float32),
            ties=Ties(
                np.zeros((count, 2), np.int32),
                rng.normal(size=(count, 2, 7)).astype(np.float32),
                rng.normal(size=(count, 2, 6, 6)).astype(np.float32),
            ),
            ancestors=np.asarray(ancestors, np.int32),
        ),
        log_evidence=-1.0,
        hypotheses=float(count),
        resampled=False,
        lost=False,
        unexpected=False,
        explained=1.0,
        keyframes=number + 1,
        is_keyframe=number % 3 == 0,
        doubt=CERTAIN,
    )


ANCESTORS = [[0], [0, 0], [1, 0, 1], [2], [0, 0], [0, 1], [1, 0, 0]]
"""Of seven frames: hypotheses branch, are dropped, and change places."""


def test_blocks_give_the_reports_that_were_put_in(seed, monkeypatch):
    """Seven in blocks of three, of one hypothesis to three; lineages go back through all of them."""
    monkeypatch.setattr(history, "FRAMES_AT_ONCE", 3)
    rng = np.random.default_rng(seed)
    infos = [_info(rng, number, ancestors) for number, ancestors in enumerate(ANCESTORS)]
    kept = History()
    for number, info in enumerate(infos):
        kept.append(10 * number, info)

    found = list(kept.infos())

    assert len(kept) == len(found) == 7
    assert kept.in_doubt
    for info, padded, ancestors in zip(infos, found, ANCESTORS, strict=True):
        count = len(ancestors)
        places = jax.tree.map(lambda leaf, count=count: leaf[:count], padded.places)
        again = replace(padded, places=places)
        assert all(
            np.array_equal(one, other)
            for one, other in zip(jax.tree.leaves(info), jax.tree.leaves(again), strict=True)
        )
    np.testing.assert_array_equal(
        kept.lineages(np.asarray([0, 2, 2])),
        [[0, 0, 0], [1, 1, 1], [2, 2, 2], [0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 2, 2]],
    )


def test_one_place_alone_is_no_doubt(seed):
    """Nor is a frame found where it was expected."""
    kept = History()
    kept.append(0, _info(np.random.default_rng(seed), 0, [0]))

    assert not kept.in_doubt
