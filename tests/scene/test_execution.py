"""Sharing a batch among cores changes nothing but the time."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scene.execution import FEWEST_PER_CORE, score_on_all_cores


@pytest.mark.parametrize("count", [1, FEWEST_PER_CORE, 2 * FEWEST_PER_CORE, 4 * FEWEST_PER_CORE + 1, 1000])
def test_every_member_is_scored_once_in_order(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Batches that divide evenly or not, on a machine of three cores; one kernel serves all shares."""
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    batch = {"number": jnp.arange(count), "row": jnp.stack([jnp.arange(count)] * 2, axis=1)}
    score = jax.jit(lambda batch: 10 * batch["number"] + batch["row"].sum(axis=1))

    actual = score_on_all_cores(score, batch)

    np.testing.assert_array_equal(actual, 12 * np.arange(count))
    assert score._cache_size() == 1  # pyright: ignore[reportAttributeAccessIssue]


def test_what_goes_wrong_in_a_share_is_told() -> None:
    """An error of one core's work is raised, not lost."""

    def score(batch: jax.Array) -> jax.Array:
        if np.any(np.asarray(batch) == 4 * FEWEST_PER_CORE - 1):
            raise ValueError("the last one")
        return batch

    with pytest.raises(ValueError, match="the last one"):
        score_on_all_cores(score, jnp.arange(4 * FEWEST_PER_CORE))
