"""One row of `bench shapes`, and the folder in which rows outlive an interruption."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.atomic import atomic_path
from pipeline.fingerprints import canonical_hash


@dataclass(frozen=True, kw_only=True, eq=False)
class ShapeRow:
    """One object from one number of views with one kind of poses.

    Attributes:
        figures: what is printed and written.
        scored: by method, probabilities and truth (2, N) of the seen voxels near the surface.
    """

    figures: dict[str, Any]
    scored: dict[str, NDArray[np.floating]]


class KeptRows:
    """Rows in a folder, a file each, so that a table can be made in slices; without a folder none is kept.

    Args:
        folder: made when the first row is kept.
        settings: everything that a row depends on besides its own name; rows of others are passed over.
    """

    def __init__(self, folder: Path | None, settings: Mapping[str, Any]) -> None:
        self._folder = folder
        self._digest = canonical_hash(settings)

    def find(self, name: str) -> ShapeRow | None:
        """The row of that name, if it was kept with the same settings and can be read."""
        if self._folder is None:
            return None
        try:
            with np.load(self._folder / f"{name}.npz") as file:
                told = json.loads(str(file["told"]))
                scored = {method: file[f"scored {method}"] for method in told["methods"]}
        except (OSError, ValueError, KeyError, zipfile.BadZipFile):
            return None
        return ShapeRow(figures=told["figures"], scored=scored) if told["settings"] == self._digest else None

    def keep(self, name: str, row: ShapeRow) -> None:
        """Write a row, whole or not at all.

        Raises:
            PipelineError: the folder cannot be written.
        """
        if self._folder is None:
            return
        told = {"settings": self._digest, "figures": row.figures, "methods": list(row.scored)}
        arrays = {f"scored {method}": values for method, values in row.scored.items()}
        with atomic_path(self._folder / f"{name}.npz") as partial:
            self._folder.mkdir(parents=True, exist_ok=True)
            np.savez_compressed(partial, told=np.asarray(json.dumps(told)), **arrays)  # type: ignore[arg-type]
