"""How far tracking came, kept in a file: a tracker that was killed goes on from there with the same numbers.

Values are trees of dataclasses, tuples, arrays and plain numbers. Their shape is written as JSON and their
arrays as an npz file, without compression; nothing but dataclasses of this program is built when it is read.
"""

from __future__ import annotations

import importlib
import json
import math
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from shapes.archive import load_arrays, save_arrays
from slam.filter.state import FilterState
from slam.smoothing import History

PACKAGES = ("recordings", "shapes", "slam")


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """Everything that the frames so far have left behind.

    Attributes:
        state: of the filter.
        history: of every frame so far, those before the map began included.
    """

    state: FilterState
    history: History

    def save(self, path: Path) -> None:
        """Write it, whole or not at all.

        Raises:
            OSError: the folder cannot be written.
        """
        arrays: list[NDArray] = []
        shape = json.dumps(_described(self, arrays))
        named = {f"a{number}": array for number, array in enumerate(arrays)}
        save_arrays(path, {"shape": np.array(shape), **named}, compressed=False)

    @classmethod
    def load(cls, path: Path) -> Checkpoint:
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: there is none.
            ValueError: the file is damaged.
        """
        arrays = load_arrays(path)
        try:
            found = _built(json.loads(str(arrays["shape"])), arrays)
        except (KeyError, TypeError, AttributeError, ImportError) as error:
            raise ValueError(f"{path} is no checkpoint: {error!r}") from error
        if not isinstance(found, cls):
            raise ValueError(f"{path} is no checkpoint")
        return found


def _described(value: Any, arrays: list[NDArray]) -> Any:
    """The shape of a value as plain JSON; its arrays are appended."""
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        arrays.append(np.asarray(value))
        return {"jax" if isinstance(value, jax.Array) else "numpy": len(arrays) - 1}
    if is_dataclass(value):
        kind = type(value)
        held = {field.name: _described(getattr(value, field.name), arrays) for field in fields(value)}
        return {"kind": f"{kind.__module__}:{kind.__qualname__}", "fields": held}
    if isinstance(value, tuple | list):
        return {type(value).__name__: [_described(one, arrays) for one in value]}
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {"float": str(value)}
    raise TypeError(f"a checkpoint holds no {type(value).__name__}")


def _built(shape: Any, arrays: dict[str, NDArray]) -> Any:
    """The value of that shape."""
    if not isinstance(shape, dict):
        return shape
    if "kind" in shape:
        kind = _dataclass(shape["kind"])
        return kind(**{name: _built(one, arrays) for name, one in shape["fields"].items()})
    ((what, content),) = shape.items()
    if what == "numpy":
        return arrays[f"a{content}"]
    if what == "jax":
        return jnp.asarray(arrays[f"a{content}"])
    if what == "float":
        return float(content)
    built = [_built(one, arrays) for one in content]
    return tuple(built) if what == "tuple" else built


def _dataclass(name: str) -> type:
    module, _, qualname = name.partition(":")
    if module.partition(".")[0] not in PACKAGES:
        raise TypeError(f"{name} is not of this program")
    kind = getattr(importlib.import_module(module), qualname)
    if not (isinstance(kind, type) and is_dataclass(kind)):
        raise TypeError(f"{name} is no dataclass")
    return kind
