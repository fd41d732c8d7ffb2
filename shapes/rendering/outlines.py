"""How much of each pixel's square a mesh fills: exact areas under its silhouette, and how they change.

The triangles that face the camera are bounded by silhouette edges. By Green's theorem the area that these
triangles cover in a pixel is a sum over the pieces of edges in it and to the left of it (signed area
accumulation, as in the rasterisation of fonts). What lies double, where a mesh covers itself, is measured
along a few lines through the pixels that edges pass, and taken from that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics

LINES = (np.arange(4) + 0.5) / 4
"""Heights in a pixel at which it is looked at for what lies double."""
LEFT = 1e-9
"""Pixels by which lines begin to the left of a pixel: pieces may stand on its edge."""
BESIDE = 1e-3
"""Pixels from an edge at which it is asked whether anything lies beside it."""


@dataclass(frozen=True, eq=False)
class Outlines:
    """Silhouette edges of B renderings.

    Attributes:
        rendering: (S,).
        ends: (S, 2, 2) column and row in pixels, whose centres are integers.
        sign: (S,) triangles on the edge's one side less those on the other.
        velocity: (S, 2, K, 2) of the ends in the image, for each of K motions.
    """

    rendering: NDArray[np.int64]
    ends: NDArray[np.float64]
    sign: NDArray[np.float64]
    velocity: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Windows:
    """Of each of B renderings the part of the image that holds it, all of one size.

    Attributes:
        first: (B, 2) column and row of the upper left pixel.
        width: in pixels.
        height: in pixels.
    """

    first: NDArray[np.int64]
    width: int
    height: int

    @classmethod
    def of(cls, outlines: Outlines, renderings: int, camera: CameraIntrinsics) -> Windows:
        """Least ones that hold these outlines as far as the image shows them, and a pixel around."""
        size = np.array([camera.width, camera.height])
        low, high = np.tile(size, (renderings, 1)), np.zeros((renderings, 2), np.int64)
        ends = np.rint(np.clip(outlines.ends, -1, size)).astype(np.int64)
        np.minimum.at(low, outlines.rendering, ends.min(axis=1))
        np.maximum.at(high, outlines.rendering, ends.max(axis=1))
        low, high = np.maximum(low - 1, 0), np.minimum(high + 2, size)
        width, height = np.maximum((high - low).max(axis=0, initial=1), 1).tolist()
        return cls(np.maximum(np.minimum(low, size - [width, height]), 0), width, height)

    def __len__(self) -> int:
        return len(self.first) * self.height * self.width

    def places(
        self, rendering: NDArray[np.int64], column: NDArray[np.int64], row: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Numbers of pixels, through all windows."""
        first = self.first[rendering]
        return (rendering * self.height + row - first[:, 1]) * self.width + column - first[:, 0]

    def pixels(self, places: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Column and row in the image."""
        line, column = np.divmod(places, self.width)
        rendering, row = np.divmod(line, self.height)
        return column + self.first[rendering, 0], row + self.first[rendering, 1]


@dataclass(frozen=True, eq=False)
class Pieces:
    """Parts (Q,) of edges, each within one pixel.

    Attributes:
        place: of its pixel, through all windows.
        start: (Q, 2) from the pixel's upper left corner.
        shift: (Q, 2) to its end.
        sign: of its edge.
        sweep: (Q, K) area that it sweeps as it moves.
    """

    place: NDArray[np.int64]
    start: NDArray[np.float64]
    shift: NDArray[np.float64]
    sign: NDArray[np.float64]
    sweep: NDArray[np.float64]

    @classmethod
    def within(cls, outlines: Outlines, windows: Windows) -> Pieces:
        """Those in the windows; what is to the left of one stands on its edge and sweeps nothing."""
        edge, middle, shift, along = _cut(outlines.ends + 0.5)
        cell = np.floor(middle).astype(np.int64)
        first = windows.first[outlines.rendering[edge]]
        last = first + np.array([windows.width, windows.height])
        seen = (cell[:, 1] >= first[:, 1]) & (cell < last).all(axis=1)
        edge, cell, first = edge[seen], cell[seen], first[seen]
        middle, shift, along = middle[seen], shift[seen], along[seen]
        left = cell[:, 0] < first[:, 0]
        cell[left, 0], middle[left, 0], shift[left, 0] = first[left, 0], first[left, 0], 0.0
        speed = outlines.velocity[edge, 0]
        speed = speed + along[:, None, None] * (outlines.velocity[edge, 1] - speed)
        sign = outlines.sign[edge]
        sweep = speed[..., 1] * shift[:, :1] - speed[..., 0] * shift[:, 1:]
        return cls(
            place=windows.places(outlines.rendering[edge], cell[:, 0], cell[:, 1]),
            start=middle - cell - shift / 2,
            shift=shift,
            sign=sign,
            sweep=sweep * (sign * ~left)[:, None],
        )

    def of(self, rows: NDArray[np.int64]) -> Pieces:
        """Some."""
        lengthwise = (self.start[rows], self.shift[rows], self.sign[rows], self.sweep[rows])
        return Pieces(self.place[rows], *lengthwise)

    def crossed(self, known: float, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Change (Q, N) of the winding number on the way from (known, known) to points (Q or 1, N, 2)."""
        start, shift = self.start[:, None], self.shift[:, None]
        before, after = (_cross(shift, one - start) > 0 for one in (known, points))
        way = points - known
        passes = (_cross(way, start - known) > 0) != (_cross(way, start + shift - known) > 0)
        return self.sign[:, None] * passes * (before.astype(np.int8) - after)


def covered_areas(
    outlines: Outlines, windows: Windows, windings: NDArray[np.int64], known: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shares of all windows' pixels that are filled, (len(windows),), and their rates of change (..., K).

    Args:
        outlines: of the renderings.
        windows: that hold them.
        windings: (len(windows),) how many triangles cover each pixel's point (known, known), ...
        known: ... from its upper left corner.
    """
    pieces, count = Pieces.within(outlines, windows), len(windows)
    step = pieces.sign * pieces.shift[:, 1]
    right = step * (pieces.start[:, 0] + pieces.shift[:, 0] / 2)
    area = np.bincount(pieces.place, step - right, minlength=count)
    onwards = (pieces.place + 1) % windows.width != 0
    area += np.bincount(pieces.place[onwards] + 1, right[onwards], minlength=count)
    area = np.cumsum(area.reshape(-1, windows.width), axis=1).ravel()
    is_double = windings.reshape(-1, windows.height * windows.width).max(axis=1, initial=0) > 1
    sweep = pieces.sweep
    if is_double.any():
        rows = np.flatnonzero(is_double[pieces.place // (windows.height * windows.width)])
        rows = rows[np.argsort(pieces.place[rows], kind="stable")]
        place, lies_double, is_hidden = _double(pieces.of(rows), windings, known)
        area[place] -= lies_double
        sweep = sweep.copy()
        sweep[rows[is_hidden]] = 0.0
    change = np.zeros((count, sweep.shape[1]))
    for one, swept in enumerate(sweep.T):
        change[:, one] = np.bincount(pieces.place, swept, minlength=count)
    change[area >= 1] = 0.0
    return np.asarray(np.clip(area, 0.0, 1.0), np.float64), change


def _double(
    pieces: Pieces, windings: NDArray[np.int64], known: float
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
    """Where a mesh covers itself: pixels (U,), areas (U,) that count double, hidden pieces (Q,).

    Args:
        pieces: pixel by pixel.
        windings: as `covered_areas` has them.
        known: likewise.
    """
    is_first = np.append(True, pieces.place[1:] != pieces.place[:-1])[: len(pieces.place)]
    first = np.flatnonzero(is_first)
    if not len(first):
        return first, np.zeros(0), np.zeros(0, np.bool_)
    place, count = pieces.place[first], np.diff(np.append(first, len(is_first)))
    pixel = np.cumsum(is_first) - 1
    left = np.column_stack([np.full(len(LINES), -LEFT), LINES])
    winding = windings[place][:, None] + np.add.reduceat(pieces.crossed(known, left[None]), first)
    lies_double = _double_lengths(pieces, pixel, np.asarray(winding, np.float64)).mean(axis=1)
    outwards = pieces.sign[:, None] * np.column_stack([-pieces.shift[:, 1], pieces.shift[:, 0]])
    length = np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-12)
    outside = pieces.start + pieces.shift / 2 + BESIDE * outwards / length
    mine = np.repeat(np.arange(len(pixel)), count[pixel])
    rank = np.arange(len(mine)) - np.repeat(np.cumsum(count[pixel]) - count[pixel], count[pixel])
    changes = pieces.of(first[pixel[mine]] + rank).crossed(known, outside[mine][:, None])[:, 0]
    winding = windings[pieces.place] + np.bincount(mine, changes, minlength=len(pixel))
    return place, lies_double, winding > 0.5


def _double_lengths(
    pieces: Pieces, pixel: NDArray[np.int64], winding: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Lengths (U, L) along lines through pixels that lie double; pieces are of these pixels (Q,).

    Args:
        pieces: of edges.
        pixel: (Q,) rows of `winding`.
        winding: (U, L) numbers at the lines' left ends.
    """
    top, fall = pieces.start[:, 1:], pieces.shift[:, 1:]
    one, line = np.nonzero((top > LINES) != (top + fall > LINES))
    along = (LINES[line] - top[one, 0]) / fall[one, 0]
    right = 1 - (pieces.start[one, 0] + along * pieces.shift[one, 0])
    group = pixel[one] * len(LINES) + line
    order = np.lexsort((-right, group))
    group, right = group[order], right[order]
    step = (pieces.sign * np.sign(pieces.shift[:, 1]))[one][order]
    total = np.cumsum(step)
    begins = np.append(True, group[1:] != group[:-1])[: len(group)]
    before_group = np.repeat((total - step)[begins], np.diff(np.append(np.flatnonzero(begins), len(group))))
    after = winding.ravel()[group] + total - before_group
    gained = np.maximum(after - 1, 0.0) - np.maximum(after - step - 1, 0.0)
    length = np.maximum(winding.ravel() - 1, 0.0)
    length += np.bincount(group, gained * right, minlength=winding.size)
    return length.reshape(winding.shape)


def _cross(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    return one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]


def _cut(
    ends: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Edges (S, 2, 2) cut where they cross integer columns and rows.

    Returns:
        Of each piece its edge (Q,), middle (Q, 2), displacement (Q, 2) and how far along the edge it is (Q,).
    """
    whole = np.arange(len(ends))
    crossings = [_crossings(ends[:, 0, axis], ends[:, 1, axis]) for axis in (0, 1)]
    edge = np.concatenate([whole, *(one for one, _ in crossings), whole])
    along = np.concatenate([np.zeros(len(ends)), *(one for _, one in crossings), np.ones(len(ends))])
    order = np.argsort(2.0 * edge + along)
    edge, along = edge[order], along[order]
    same = edge[1:] == edge[:-1]
    edge, first, last = edge[1:][same], along[:-1][same], along[1:][same]
    shift = (ends[:, 1] - ends[:, 0])[edge]
    middle = (first + last) / 2
    return edge, ends[edge, 0] + middle[:, None] * shift, (last - first)[:, None] * shift, middle


def _crossings(
    first: NDArray[np.float64], last: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Edge and share of its length at which it crosses an integer."""
    low, high = np.floor(np.minimum(first, last)), np.floor(np.maximum(first, last))
    count = (high - low).astype(np.int64)
    edge = np.repeat(np.arange(len(count)), count)
    place = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    line = low[edge] + 1 + place
    return edge, (line - first[edge]) / (last - first)[edge]
