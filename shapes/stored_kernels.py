"""Kernels whose traces outlive the process.

JAX keeps what it compiled, but traces a function anew in every process: of the scene's chains that takes six
times as long as loading what was compiled. Here the trace is kept, too, as portable StableHLO (`jax.export`).
What runs is always made from that, so that the first process computes the same bytes as those after it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, update_wrapper, wraps
from hashlib import sha256
from importlib import import_module
from inspect import signature
from typing import Any, Generic, Protocol, TypeVar

import jax
import jax.export
from jax import tree_util
from jax.core import Tracer

R = TypeVar("R")

SETTINGS = (
    "jax_enable_x64",
    "jax_threefry_partitionable",
    "jax_default_prng_impl",
    "jax_default_matmul_precision",
)
"""Of JAX, by which traces of the same sources and arguments differ."""

CompilerOptions = Mapping[str, bool | int]

Tree = Any
"""Of JAX: what is left of a value without its leaves."""


class TraceStore(Protocol):
    """Bytes by key."""

    def get(self, key: str) -> bytes | None:
        """None where there are none."""

    def put(self, key: str, value: bytes) -> None:
        """Keep them, if that can be."""


@dataclass(frozen=True)
class _Traces:
    """Where traces are kept, and what they depend on beside their arguments."""

    store: TraceStore
    version: str


_traces: _Traces | None = None


def keep_traces(store: TraceStore | None, version: str = "") -> None:
    """Keep traces of kernels that are traced from now on; None keeps none.

    Args:
        store: of traces.
        version: of all sources and libraries that make them.
    """
    global _traces
    _traces = None if store is None else _Traces(store, version)


def jit_stored(
    static_argnames: tuple[str, ...] = (), compiler_options: CompilerOptions | None = None
) -> Callable[[Callable[..., R]], StoredKernel[R]]:
    """`jax.jit`, with a trace that is kept. Static arguments are plain values or functions of modules."""
    return lambda function: StoredKernel(function, static_argnames, dict(compiler_options or {}))


class StoredKernel(Generic[R]):
    """A function that is compiled from a trace that is kept.

    It is what `jax.jit` makes of it within another trace, where no trace is kept, and where JAX checks that
    no key is used twice, which it does in traces.

    Attributes:
        function: of which it is.
    """

    def __init__(
        self, function: Callable[..., R], static_argnames: tuple[str, ...], compiler_options: dict[str, Any]
    ) -> None:
        """The kernel of a function."""

        @wraps(function)
        def from_store(*args: Any, **kwargs: Any) -> R:
            assert _traces is not None
            return _called(function, static_argnames, _traces, *args, **kwargs)

        jit = partial(jax.jit, static_argnames=static_argnames, compiler_options=compiler_options)
        self.function, self._jitted, self._stored = function, jit(function), jit(from_store)
        update_wrapper(self, function)

    def __call__(self, *args: Any, **kwargs: Any) -> R:
        """What the function returns."""
        return self._in_use(args, kwargs)(*args, **kwargs)

    def lower(self, *args: Any, **kwargs: Any) -> jax.stages.Lowered:
        """As that of `jax.jit`."""
        return self._in_use(args, kwargs).lower(*args, **kwargs)

    def _in_use(self, *arguments: Any) -> Any:
        if _traces is None or jax.config.jax_debug_key_reuse:  # pyright: ignore[reportAttributeAccessIssue]
            return self._jitted
        within = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(arguments))
        return self._jitted if within else self._stored


def _called(
    function: Callable[..., R], static_argnames: Sequence[str], traces: _Traces, *args: Any, **kwargs: Any
) -> R:
    """What a function returns, by the trace that is kept of it, or is made and kept now."""
    given = signature(function).bind(*args, **kwargs).arguments
    static = {name: given.pop(name) for name in static_argnames if name in given}
    leaves, tree = jax.tree.flatten(given)
    key = _key(function, leaves, tree, static, traces.version)
    stored = traces.store.get(key)
    if stored is None:
        stored = _traced(function, leaves, tree, static)
        traces.store.put(key, stored)
    described, _, trace = stored.partition(b"\n")
    exported = jax.export.deserialize(bytearray(trace))
    return jax.tree.unflatten(_tree(json.loads(described)), exported.call(*leaves))


def _key(
    function: Callable[..., Any], leaves: Sequence[Any], tree: Tree, static: Mapping[str, Any], version: str
) -> str:
    """Of a trace, in any process."""
    described = [
        version,
        _described_value(function),
        _described(tree),
        [str(jax.typeof(leaf)) for leaf in leaves],
        [[name, _described_value(value)] for name, value in static.items()],
        [str(getattr(jax.config, name)) for name in SETTINGS],
    ]
    return f"trace-{sha256(json.dumps(described).encode()).hexdigest()}"


def _traced(
    function: Callable[..., Any], leaves: Sequence[Any], tree: Tree, static: Mapping[str, Any]
) -> bytes:
    """The tree of what a function returns, and the trace from leaves to leaves."""
    trees = []

    def flat(*leaves: jax.Array) -> list[jax.Array]:
        returned, returned_tree = jax.tree.flatten(function(**jax.tree.unflatten(tree, leaves), **static))
        trees.append(returned_tree)
        return returned

    flat.__name__ = function.__name__
    types = [jax.typeof(leaf) for leaf in leaves]
    exported = jax.export.export(jax.jit(flat))(*types)
    return json.dumps(_described(trees[0])).encode() + b"\n" + exported.serialize()


def _described(tree: Tree) -> Any:
    """A tree in plain values: a node's type, what is static in it, and its children; a leaf is None."""
    node = tree.node_data()
    if node is None:
        return None
    nodetype, static = node
    fixed = None if static is None else [_described_value(value) for value in static]
    return [nodetype.__module__, nodetype.__qualname__, fixed, [_described(one) for one in tree.children()]]


def _tree(described: Any) -> Tree:
    """The tree that is described so."""
    if described is None:
        return jax.tree.structure(0)
    module, name, static, children = described
    nodetype = getattr(import_module("types" if name == "NoneType" else module), name)
    return tree_util.PyTreeDef.from_node_data_and_children(
        tree_util.default_registry,
        (nodetype, _value(static)),
        [_tree(one) for one in children],
    )


def _described_value(value: Any) -> Any:
    """A static value; a function is described by where it is defined.

    Raises:
        TypeError: it is neither plain nor a function of a module.
    """
    if isinstance(value, tuple):
        return [_described_value(one) for one in value]
    if value is None or isinstance(value, str | int | float):
        return value
    name = getattr(value, "__qualname__", "<unknown>")
    if "<" in name:
        raise TypeError(f"{value!r} means nothing in another process")
    return f"{value.__module__}.{name}"


def _value(described: Any) -> Any:
    return tuple(map(_value, described)) if isinstance(described, list) else described
