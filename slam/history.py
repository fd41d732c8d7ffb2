"""What the filter reported of every frame; memory hardly grows with them, for blocks of them are paged."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import jax
import numpy as np
from numpy.typing import NDArray

from slam.filter.init import first_frame_info
from slam.filter.state import FrameInfo
from slam.keyframes.pages import Paged, PageFile

FRAMES_AT_ONCE = 256
"""In a block, 1.5 MB: kernels of what follows are compiled for so many."""

_STRUCTURE = jax.tree.structure(first_frame_info(compared=1))
"""Of any frame's report."""


@dataclass(frozen=True)
class FrameBlock:
    """Reports of n frames one after the other, their leaves stacked (n, ...), in the order of the tree."""

    ARRAYS: ClassVar[int] = _STRUCTURE.num_leaves
    ROOM: ClassVar[int] = 2
    """They are read one after the other."""

    leaves: tuple[NDArray[Any], ...]

    @classmethod
    def of(cls, infos: Sequence[FrameInfo]) -> FrameBlock:
        """Those reports; of fewer hypotheses than the most, they are filled up with zeros."""
        most = max(len(info.places.anchors) for info in infos)
        padded = [
            jax.tree.leaves(replace(info, places=jax.tree.map(partial(_filled, most), info.places)))
            for info in infos
        ]
        return cls(tuple(np.stack(of_all) for of_all in zip(*padded, strict=True)))

    @property
    def infos(self) -> Any:
        """A `FrameInfo` whose leaves are stacked (n, ...)."""
        return _STRUCTURE.unflatten(self.leaves)

    def stored(self) -> Sequence[NDArray[Any]]:
        """All of it."""
        return self.leaves

    def with_stored(self, arrays: Sequence[Any]) -> FrameBlock:
        """With those arrays."""
        return FrameBlock(tuple(arrays))


def _filled(count: int, of_hypotheses: NDArray[Any]) -> NDArray[Any]:
    return np.pad(of_hypotheses, ((0, count - len(of_hypotheses)), *[(0, 0)] * (of_hypotheses.ndim - 1)))


@dataclass(kw_only=True)
class History:
    """The reports so far.

    Attributes:
        pages: where blocks go.
        times_ns: stamps of all frames.
        blocks: whole ones.
        latest: reports since the last of them.
        in_doubt: whether some frame was not found where it was expected, or in two places.
    """

    pages: PageFile = field(default_factory=PageFile)
    times_ns: list[int] = field(default_factory=list)
    blocks: list[Paged[FrameBlock]] = field(default_factory=list)
    latest: list[FrameInfo] = field(default_factory=list)
    in_doubt: bool = False

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.times_ns)

    def append(self, time_ns: int, info: FrameInfo) -> None:
        """One frame more."""
        self.times_ns.append(time_ns)
        self.latest.append(info)
        self.in_doubt |= info.unexpected or len(info.places.anchors) > 1
        if len(self.latest) == FRAMES_AT_ONCE:
            self.blocks.append(self.pages.hold(FrameBlock.of(self.latest)))
            self.latest = []

    def stacked(self) -> Iterator[tuple[slice, Any]]:
        """Frames, and their reports as one `FrameInfo` with leaves stacked (n, ...), block by block."""
        for number, block in enumerate(self.blocks):
            yield slice(number * FRAMES_AT_ONCE, (number + 1) * FRAMES_AT_ONCE), block.value.infos
        if self.latest:
            yield slice(len(self) - len(self.latest), len(self)), FrameBlock.of(self.latest).infos

    def infos(self) -> Iterator[FrameInfo]:
        """Report after report."""
        for frames, stacked in self.stacked():
            for index in range(frames.stop - frames.start):
                yield jax.tree.map(lambda leaf, index=index: leaf[index], stacked)

    def lineages(self, last: NDArray[np.int_]) -> NDArray[np.int32]:
        """Which hypothesis (T, G) of each frame those of the last one (G,) go on."""
        lineages = np.empty((len(self), len(last)), np.int32)
        latest = [FrameBlock.of(self.latest)] if self.latest else []
        end = len(self)
        for block in (*latest, *(held.value for held in reversed(self.blocks))):
            ancestors = block.infos.places.ancestors
            for index in range(len(ancestors) - 1, -1, -1):
                end -= 1
                lineages[end] = last
                last = ancestors[index, last]
        return lineages
