"""Sharing a batch among cores changes nothing but the time."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scene.execution import PER_SHARE, score_on_all_cores


@pytest.mark.parametrize("count", [1, PER_SHARE, 2 * PER_SHARE, 4 * PER_SHARE + 1, 1000])
def test_every_member_is_scored_once_in_order(count: int) -> None:
    """Batches that divide evenly or not; one kernel serves all shares."""
    batch = {"number": jnp.arange(count), "row": jnp.stack([jnp.arange(count)] * 2, axis=1)}
    score = jax.jit(lambda batch: 10 * batch["number"] + batch["row"].sum(axis=1))

    actual = score_on_all_cores(score, batch)

    np.testing.assert_array_equal(actual, 12 * np.arange(count))
    assert score._cache_size() == 1  # pyright: ignore[reportAttributeAccessIssue]


def test_the_number_of_cores_changes_no_share(monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker with one core and a machine with five score the same shares."""

    def shares_of(cores: int) -> list[tuple[int, ...]]:
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)
        shares: list[tuple[int, ...]] = []

        def score(batch: jax.Array) -> jax.Array:
            shares.append(tuple(np.asarray(batch).tolist()))
            return batch

        score_on_all_cores(score, jnp.arange(700))
        return sorted(shares)

    assert shares_of(1) == shares_of(5)
    assert len(shares_of(1)) == 11


def test_what_goes_wrong_in_a_share_is_told() -> None:
    """An error of one core's work is raised, not lost."""

    def score(batch: jax.Array) -> jax.Array:
        if np.any(np.asarray(batch) == 4 * PER_SHARE - 1):
            raise ValueError("the last one")
        return batch

    with pytest.raises(ValueError, match="the last one"):
        score_on_all_cores(score, jnp.arange(4 * PER_SHARE))
