"""Kernels whose traces outlive the process.

JAX keeps what it compiled, but traces a function anew in every process: of the scene's chains that takes six
times as long as loading what was compiled. Here the trace is kept, too, as portable StableHLO (`jax.export`).
What runs is always made from that, so that the first process computes the same bytes as those after it.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from functools import update_wrapper
from hashlib import sha256
from importlib import import_module
from threading import Lock
from typing import Any, Generic, Protocol, TypeVar

import jax
import jax.export
from jax import tree_util
from jax.core import Tracer

R = TypeVar("R")

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
    """Keep traces of kernels from now on; None keeps none.

    Args:
        store: of traces.
        version: of all sources and libraries that make them.
    """
    global _traces
    _traces = None if store is None else _Traces(store, version)


def _setting(name: str) -> bool:
    """Of JAX, in this thread."""
    return getattr(jax.config, name)


def _traces_in_use() -> _Traces | None:
    """None on accelerators, too: there nobody has tried what `jax.export` promises of the CPU."""
    return None if _setting("jax_debug_key_reuse") or jax.default_backend() != "cpu" else _traces


def jit_stored(
    static_argnames: tuple[str, ...] = (), compiler_options: CompilerOptions | None = None
) -> Callable[[Callable[..., R]], StoredKernel[R]]:
    """`jax.jit`, with a trace that is kept. Static arguments are plain values or functions of modules."""
    return lambda function: StoredKernel(function, static_argnames, dict(compiler_options or {}))


class StoredKernel(Generic[R]):
    """A function that is traced once for arguments alike, and compiled.

    It is what `jax.jit` makes of it within another trace, where no trace is kept, and where JAX checks that
    no key is used twice, which it does in traces.
    """

    def __init__(
        self, function: Callable[..., R], static_argnames: tuple[str, ...], compiler_options: dict[str, Any]
    ) -> None:
        """The kernel of a function."""
        self._jitted = jax.jit(function, static_argnames=static_argnames, compiler_options=compiler_options)
        self._function, self._static, self._options = function, static_argnames, compiler_options
        self._signature = inspect.signature(function)
        self._ready: dict[Hashable, Callable[..., R]] = {}
        self._preparing = Lock()
        update_wrapper(self, function)

    def __call__(self, *args: Any, **kwargs: Any) -> R:
        """What the function returns."""
        traces = _traces_in_use()
        call = None if traces is None else self._call(*args, **kwargs)
        if traces is None or call is None or call.is_traced:
            return self._jitted(*args, **kwargs)
        return self._prepared(call, traces)(*call.leaves)

    def compile(self, *args: Any, **kwargs: Any) -> None:
        """Have the kernel ready for arguments like these."""
        traces = _traces_in_use()
        if traces is None:
            self.lower(*args, **kwargs).compile()
        else:
            self._prepared(self._call(*args, **kwargs), traces)

    def lower(self, *args: Any, **kwargs: Any) -> jax.stages.Lowered:
        """What `jax.jit` lowers."""
        return self._jitted.lower(*args, **kwargs)

    def _call(self, *args: Any, **kwargs: Any) -> _Call:
        given = self._signature.bind(*args, **kwargs).arguments
        static = tuple((name, given.pop(name)) for name in self._static if name in given)
        leaves, tree = jax.tree.flatten(given)
        return _Call(leaves, tree, static)

    def _prepared(self, call: _Call, traces: _Traces) -> Callable[..., R]:
        """What runs, given leaves."""
        kind = call.kind, traces.version
        if kind not in self._ready:
            with self._preparing:  # whoever calls what is being compiled waits for it
                if kind not in self._ready:
                    self._ready[kind] = self._compiled(call, traces)
        return self._ready[kind]

    def _compiled(self, call: _Call, traces: _Traces) -> Callable[..., R]:
        named = self._function.__module__, self._function.__qualname__, call.described, traces.version
        key = f"trace-{sha256(json.dumps(named).encode()).hexdigest()}"
        stored = traces.store.get(key)
        if stored is None:
            stored = self._traced(call)
            traces.store.put(key, stored)
        exported, tree = _loaded(stored)
        run = jax.jit(exported.call, compiler_options=self._options).lower(*call.leaves).compile()
        return lambda *leaves: jax.tree.unflatten(tree, run(*leaves))

    def _traced(self, call: _Call) -> bytes:
        """The trace, and the tree of what it returns."""
        trees = []

        def flat(*leaves: jax.Array) -> list[jax.Array]:
            given = jax.tree.unflatten(call.tree, leaves)
            returned, tree = jax.tree.flatten(self._function(**given, **dict(call.static)))
            trees.append(tree)
            return returned

        flat.__name__ = self._function.__name__
        exported = jax.export.export(jax.jit(flat))(*call.leaves)
        return json.dumps(_described(trees[0])).encode() + b"\n" + exported.serialize()


def _loaded(stored: bytes) -> tuple[jax.export.Exported, Tree]:
    tree, _, trace = stored.partition(b"\n")
    return jax.export.deserialize(bytearray(trace)), _tree(json.loads(tree))


@dataclass(frozen=True, eq=False)
class _Call:
    """Arguments: the leaves of those that are not static, their tree, and static ones by name."""

    leaves: list[Any]
    tree: Tree
    static: tuple[tuple[str, Any], ...]

    @property
    def is_traced(self) -> bool:
        """Whether some are being traced."""
        return any(isinstance(leaf, Tracer) for leaf in self.leaves)

    @property
    def kind(self) -> Hashable:
        """What one compiled kernel serves."""
        types = tuple(map(_type_of, self.leaves))
        return self.tree, self.static, types, _setting("jax_enable_x64")

    @property
    def described(self) -> list[Any]:
        """The same, in values that mean the same in another process."""
        types = [str(jax.typeof(leaf)) for leaf in self.leaves]
        static = [[name, _described_value(value)] for name, value in self.static]
        return [_described(self.tree), static, types, _setting("jax_enable_x64")]


def _type_of(leaf: Any) -> Hashable:
    """As `jax.typeof`, which takes ten times as long, or finer."""
    return getattr(leaf, "shape", ()), getattr(leaf, "dtype", type(leaf)), getattr(leaf, "weak_type", False)


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
