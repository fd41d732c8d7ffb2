"""Compile time is told apart from the rest."""

import time

import jax
import jax.numpy as jnp
import pytest

from pipeline.timing import timed


def test_compiling_is_not_counted_as_work() -> None:
    """The first call compiles, the second does not; sleeping is work."""

    @jax.jit
    def kernel(x: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, 3, lambda _, y: jnp.sin(y) @ y, x)

    x = jnp.ones((8, 8))
    with timed() as first:
        kernel(x).block_until_ready()
    with timed() as second:
        kernel(x).block_until_ready()
        time.sleep(0.05)

    assert first.compile_s > 0.001
    assert second.compile_s == 0
    assert second.seconds >= 0.05


def test_a_failure_stops_the_clock() -> None:
    """And listens no longer."""
    with pytest.raises(ZeroDivisionError), timed() as timing:
        raise ZeroDivisionError

    before = timing.compile_s
    jax.jit(lambda x: x + 1.5)(jnp.ones(3))
    assert timing.compile_s == before
