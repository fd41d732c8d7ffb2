"""How far tracking came, kept in a file: a tracker that was killed goes on from there with the same numbers.

Values are trees of dataclasses, tuples, arrays and plain numbers. Their shape is written as JSON and their
arrays as an npz file, without compression; nothing but dataclasses of this program is built when it is read.
What is paged stays in the file of pages, and where it is there is written.
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
from slam.history import History
from slam.keyframes.pages import Paged, PageFile
from slam.pose_graph.overlaps import KeyframeDetail

PACKAGES = ("recordings", "shapes", "slam")


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """Everything that the frames so far have left behind.

    Attributes:
        state: of the filter.
        history: of every frame so far, those before the map began included.
        details: of the keyframes.
    """

    state: FilterState
    history: History
    details: list[Paged[KeyframeDetail]]

    def save(self, path: Path) -> None:
        """Write it, whole or not at all; pages that are in memory alone are written to their file first.

        Raises:
            OSError: the folder cannot be written.
        """
        arrays: list[NDArray] = []
        shape = json.dumps(_Writer(arrays, {}).described(self))
        pages = self.history.pages
        pages.flush()
        named = {f"a{number}": array for number, array in enumerate(arrays)}
        save_arrays(
            path, {"shape": np.array(shape), "pages_size": np.array(pages.size), **named}, compressed=False
        )

    @classmethod
    def load(cls, path: Path, pages: PageFile) -> Checkpoint:
        """Read what `save` wrote, its pages being in that file.

        Raises:
            FileNotFoundError: there is none.
            ValueError: the file is damaged, or the pages are not all there.
        """
        arrays = load_arrays(path)
        try:
            if pages.size < int(arrays["pages_size"]):
                raise ValueError(f"{path} has lost its pages")
            found = _Reader(arrays, {}, pages).built(json.loads(str(arrays["shape"])))
        except (KeyError, TypeError, AttributeError, ImportError) as error:
            raise ValueError(f"{path} is no checkpoint: {error!r}") from error
        if not isinstance(found, cls):
            raise ValueError(f"{path} is no checkpoint")
        return found


@dataclass(frozen=True)
class _Writer:
    """Takes values apart; arrays that several of them share are written once."""

    arrays: list[NDArray]
    numbers: dict[int, int]

    def described(self, value: Any) -> Any:
        """The shape of a value as plain JSON; its arrays are appended."""
        if isinstance(value, jax.Array | np.ndarray | np.generic):
            return {"jax" if isinstance(value, jax.Array) else "numpy": self._number(value)}
        if isinstance(value, PageFile):
            return {"pages": True}
        if isinstance(value, Paged):
            return {"page": value.written(), "of": self.described(value.skeleton)}
        if is_dataclass(value):
            kind = type(value)
            held = {field.name: self.described(getattr(value, field.name)) for field in fields(value)}
            return {"kind": f"{kind.__module__}:{kind.__qualname__}", "fields": held}
        if isinstance(value, tuple | list):
            return {type(value).__name__: [self.described(one) for one in value]}
        if value is None or isinstance(value, bool | int | str):
            return value
        if isinstance(value, float):
            return value if math.isfinite(value) else {"float": str(value)}
        raise TypeError(f"a checkpoint holds no {type(value).__name__}")

    def _number(self, array: jax.Array | NDArray[Any] | np.generic) -> int:
        number = self.numbers.setdefault(id(array), len(self.arrays))
        if number == len(self.arrays):
            self.arrays.append(np.asarray(array))
        return number


@dataclass(frozen=True)
class _Reader:
    """Builds values from their shapes; what was one array is one again."""

    arrays: dict[str, NDArray]
    shared: dict[int, jax.Array]
    pages: PageFile

    def built(self, shape: Any) -> Any:
        """The value of that shape."""
        if not isinstance(shape, dict):
            return shape
        if "kind" in shape:
            kind = _dataclass(shape["kind"])
            return kind(**{name: self.built(one) for name, one in shape["fields"].items()})
        if "page" in shape:
            return Paged(self.pages, self.built(shape["of"]), None, int(shape["page"]))
        ((what, content),) = shape.items()
        if what == "pages":
            return self.pages
        if what == "numpy":
            return self.arrays[f"a{content}"]
        if what == "jax":
            if content not in self.shared:
                self.shared[content] = jnp.asarray(self.arrays[f"a{content}"])
            return self.shared[content]
        if what == "float":
            return float(content)
        built = [self.built(one) for one in content]
        return tuple(built) if what == "tuple" else built


def _dataclass(name: str) -> type:
    module, _, qualname = name.partition(":")
    if module.partition(".")[0] not in PACKAGES:
        raise TypeError(f"{name} is not of this program")
    kind = getattr(importlib.import_module(module), qualname)
    if not (isinstance(kind, type) and is_dataclass(kind)):
        raise TypeError(f"{name} is no dataclass")
    return kind
