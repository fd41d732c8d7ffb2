"""Reports of frames, block by block."""

from dataclasses import replace

import jax
import numpy as np

from slam import history
from slam.filter.rival_motion import CERTAIN
from slam.filter.state import FrameInfo, Ties
from slam.history import History

PARTICLES = 4


def _info(rng: np.random.Generator, number: int, components: int) -> FrameInfo:
    return FrameInfo(
        anchor=number,
        relative_poses=rng.normal(size=(PARTICLES, 7)).astype(np.float32),
        relative_means=rng.normal(size=(PARTICLES, 7)).astype(np.float32),
        component=np.zeros(PARTICLES, np.int32),
        component_covariances=rng.normal(size=(components, 6, 6)).astype(np.float32),
        field_sensitivity=np.zeros((6, 63), np.float32),
        ties=Ties.none(2),
        log_weights=np.full(PARTICLES, -np.log(PARTICLES), np.float32),
        ancestors=rng.permutation(PARTICLES).astype(np.int32),
        log_evidence=-1.0,
        ess=4.0,
        resampled=False,
        lost=False,
        unexpected=False,
        explained=1.0,
        covered=1.0,
        keyframes=number + 1,
        is_keyframe=number % 3 == 0,
        components=components,
        doubt=CERTAIN,
    )


def test_blocks_give_the_reports_that_were_put_in(seed, monkeypatch):
    """Seven in blocks of three, of one component and of two; lineages go back through all of them."""
    monkeypatch.setattr(history, "FRAMES_AT_ONCE", 3)
    rng = np.random.default_rng(seed)
    infos = [_info(rng, number, 1 + number % 2) for number in range(7)]
    kept = History()
    for number, info in enumerate(infos):
        kept.append(10 * number, info)

    found = list(kept.infos())

    assert len(kept) == len(found) == 7
    assert kept.in_doubt
    for info, again in zip(infos, found, strict=True):
        again = replace(again, component_covariances=again.component_covariances[: info.components])
        assert all(
            np.array_equal(one, other)
            for one, other in zip(jax.tree.leaves(info), jax.tree.leaves(again), strict=True)
        )
    lineages = kept.lineages()
    np.testing.assert_array_equal(lineages[-1], np.arange(PARTICLES))
    for number in range(1, 7):
        np.testing.assert_array_equal(infos[number].ancestors[lineages[number]], lineages[number - 1])


def test_one_place_alone_is_no_doubt(seed):
    """Nor is a frame found where it was expected."""
    kept = History()
    kept.append(0, _info(np.random.default_rng(seed), 0, 1))

    assert not kept.in_doubt
