"""Kernels whose traces are kept: what they compute, when they are traced, and what they refuse."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.typing import ArrayLike

from shapes.stored_kernels import StoredKernel, jit_stored, keep_traces


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Line:
    """A value with a static part."""

    slope: ArrayLike
    offset: ArrayLike | None = None
    size: tuple[int, int] = field(default=(1, 2), metadata={"static": True})


def doubled(values: jax.Array) -> jax.Array:
    """A function of a module."""
    return 2 * values


class Traced:
    """A function that counts how often it is traced."""

    def __init__(self) -> None:
        self.times = 0

    def kernel(self) -> StoredKernel[tuple[Line, list[jax.Array]]]:
        """Of the same name in every process."""

        def place(line: Line, at: jax.Array, by=doubled, power: int = 1) -> tuple[Line, list[jax.Array]]:
            self.times += 1
            value = by(jnp.asarray(line.slope) * at) ** power
            return Line(value, None, line.size), [jnp.linalg.cholesky(jnp.eye(2) * value.sum())]

        place.__qualname__ = "place"
        return jit_stored(static_argnames=("by", "power"))(place)


class Store:
    """Bytes by key, in memory."""

    def __init__(self) -> None:
        self.kept: dict[str, bytes] = {}

    def __len__(self) -> int:
        return len(self.kept)

    def get(self, key: str) -> bytes | None:
        """None where there are none."""
        return self.kept.get(key)

    def put(self, key: str, value: bytes) -> None:
        """Keep them."""
        self.kept[key] = value


@pytest.fixture
def store() -> Iterator[Store]:
    """Where traces are kept while a test runs; JAX looks for keys that are used twice in traces alone."""
    kept = Store()
    keep_traces(kept, "1")
    with jax.debug_key_reuse(False):
        yield kept
    keep_traces(None)


LINE = Line(np.arange(1, 4, dtype=np.float32))


def test_another_process_computes_the_same_without_tracing(store: Store) -> None:
    """Of trees with static parts, nothing in places, and lists."""
    first, second = Traced(), Traced()
    one = first.kernel()(LINE, 2.0, power=2)
    other = second.kernel()(LINE, 2.0, power=2)

    assert (first.times, second.times, len(store)) == (1, 0, 1)
    assert jax.tree.structure(one) == jax.tree.structure(other)
    assert one[0].size == other[0].size == (1, 2)
    np.testing.assert_array_equal(one[0].slope, [16, 64, 144])
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.parametrize(
    ("line", "at", "power"),
    [
        (Line(np.arange(4, dtype=np.float32)), 2.0, 2),  # of another size
        (Line(np.arange(1, 4, dtype=np.int32)), 2.0, 2),  # of another type
        (Line(LINE.slope, np.ones(1)), 2.0, 2),  # of another tree
        (Line(LINE.slope, None, (2, 2)), 2.0, 2),  # with another static part
        (LINE, np.float32(2.0), 2),  # a type that is not weak
        (LINE, 2.0, 3),  # with another static argument
    ],
)
def test_other_arguments_have_traces_of_their_own(store: Store, line: Line, at: float, power: int) -> None:
    """What differs but in values is traced."""
    traced = Traced()
    kernel = traced.kernel()
    kernel(LINE, 2.0, power=2)
    kernel(line, at, power=power)
    kernel(LINE, 3.0, power=2)

    assert (traced.times, len(store)) == (2, 2)


def test_other_sources_and_settings_have_traces_of_their_own(store: Store) -> None:
    """Of a trace constants depend on the precision, and random numbers on how they are made."""
    traced = Traced()
    kernel = traced.kernel()
    kernel(LINE, 2.0)
    keep_traces(store, "2")
    kernel = traced.kernel()  # of a process of the other version
    kernel(LINE, 2.0)
    with jax.enable_x64(True):
        kernel(LINE, np.float32(2.0))
    with jax.threefry_partitionable(False):
        kernel(LINE, 2.0)

    assert (traced.times, len(store)) == (4, 4)


def test_a_kernel_that_is_compiled_before_is_not_compiled_again(store: Store) -> None:
    """As what the search compiles beside its work."""
    traced = Traced()
    kernel = traced.kernel()
    kernel.lower(LINE, 2.0).compile()
    kernel(LINE, 5.0)

    assert (traced.times, len(store)) == (1, 1)


def test_within_another_trace_it_is_traced_with_that(store: Store) -> None:
    """In kernels and over batches."""
    kernel = Traced().kernel()
    batch = jax.vmap(lambda slope: kernel(Line(slope), 1.0)[0].slope)(jnp.ones((2, 3)))
    inside = jax.jit(lambda slope: kernel(Line(slope), 1.0)[0].slope)(jnp.ones(3))

    np.testing.assert_array_equal(batch, 2 * np.ones((2, 3)))
    np.testing.assert_array_equal(inside, 2 * np.ones(3))
    assert not len(store)


def test_where_keys_are_checked_nothing_is_kept(store: Store) -> None:
    """The check looks at traces: it must not miss those that come from a store."""

    @jit_stored()
    def twice(key: jax.Array) -> jax.Array:
        return jax.random.uniform(key) + jax.random.normal(key)

    with jax.debug_key_reuse(True), pytest.raises(jax.errors.KeyReuseError):
        twice(jax.random.key(0))
    assert not len(store)


def test_what_means_nothing_in_another_process_is_refused(store: Store) -> None:
    """A function without a name would have one trace for many."""
    with pytest.raises(TypeError, match="means nothing in another process"):
        Traced().kernel()(LINE, 2.0, by=lambda values: values)
    assert not len(store)
