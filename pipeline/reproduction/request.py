"""What `voxscene reproduce` was asked for."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pipeline.benchmarks.pose_sources import BopImages
from pipeline.mesh_source import MeshSource
from pipeline.task_engine import Executors


@dataclass(frozen=True, kw_only=True, eq=False)
class Request:
    """What is measured, where, and whom to tell.

    Attributes:
        out: folder of page, tables, figures and kept rows.
        shapes: the objects.
        images: challenging images of each kind.
        data: a data set with real images, where the user has one.
        peers: names of registration peers.
        seed: root of all randomness.
        executors: where images are judged.
        at_once: so many of them.
        say: is given sentences for people.
        progress: is told images done and in all.
    """

    out: Path
    shapes: MeshSource
    images: int
    data: BopImages | None
    peers: tuple[str, ...]
    seed: int
    executors: Executors
    at_once: int
    say: Callable[[str], None]
    progress: Callable[[int, int | None], None]

    @property
    def rows(self) -> Path:
        """Where rows are kept between runs."""
        return self.out / "rows"

    def command(self, *words: str, meshes: bool = True) -> str:
        """A command of the program that makes one part alone."""
        of_meshes = self._of_meshes if meshes else []
        return shlex.join(["voxscene", *words, *of_meshes, "--seed", str(self.seed)])

    @property
    def _of_meshes(self) -> list[str]:
        """Options that name the objects; the built-in ones need none."""
        shapes = self.shapes
        said = {
            "--meshes": shapes.folder and str(shapes.folder),
            "--units": shapes.folder and shapes.units,
            "--only": ",".join(shapes.names),
        }
        return [word for option, value in said.items() if value for word in (option, value)]
