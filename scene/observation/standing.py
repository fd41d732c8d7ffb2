"""What stands on which support: connected pieces of a depth image, and which of them are furniture.

A pixel belongs to the highest support below it. A piece is what hangs together and is no support's surface;
it is furniture where it goes on higher than things do, is under a support, as the legs of a table are, or is
a board, as the back of a seat.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from recordings.types import NO_RETURN
from scene.observation.depth_view import SAME_SURFACE_M
from scene.observation.detection import NARROWEST_HALF_M, SHORTEST_HALF_M, SupportPlane

LOWEST_M = 0.006

HIGHEST_M = 0.5
"""Things on a support are not higher, nor larger."""

MARGIN_M = 0.05
"""By which things reach out beyond the edge of their support as it was seen."""

FEWEST_PIXELS = 100
"""Of a thing beside the first support; less are crumbs."""

BOARD_M = 0.04
"""A flat piece is not thicker, seen warped (`detection.WARPED_M`), and as wide as a support has to be."""

FURNITURE_SHARE = 0.25
"""Of a piece's pixels that are too high, or under a support; less are flying pixels at its outline."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """Connected pieces of an image (H, W).

    Attributes:
        number: (H, W) of the piece, -1 where nothing was measured or a support's surface is seen.
        support: (P,) number of the support under each piece, -1 where there is none.
        furniture: (P,) bool.
        diagonal_m: (P,) of a cuboid that is spread like the piece.
        pixels: (P,) count of them.
    """

    number: NDArray[np.intp]
    support: NDArray[np.intp]
    furniture: NDArray[np.bool_]
    diagonal_m: NDArray[np.float64]
    pixels: NDArray[np.intp]

    def carried(self, supports: int) -> NDArray[np.float64]:
        """Pixels (supports,) of what stands on each support and is no furniture.

        Of a larger piece than things are so many count as of a thing at its place.
        """
        things = ~self.furniture & (self.support >= 0)
        count = self.pixels * (HIGHEST_M / np.maximum(self.diagonal_m, HIGHEST_M)) ** 2
        return np.bincount(self.support[things], count[things], minlength=supports).astype(np.float64)

    def things_on(self, supports: Sequence[int]) -> NDArray[np.bool_]:
        """Pixels (H, W) of pieces on some supports that look like things.

        No furniture, nor larger than things are, nor crumbs; they do not reach out of the image.
        """
        things = np.isin(self.support, supports) & ~self.furniture & (self.diagonal_m < HIGHEST_M)
        things &= self.pixels >= FEWEST_PIXELS
        inner = np.full(self.number.shape, False)
        inner[1:-1, 1:-1] = True
        cut = np.unique(self.number[~inner & (self.number >= 0)])
        things[cut] = False
        return np.append(things, False)[self.number]


def is_over(support: SupportPlane, points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (H, W, 3) are above a support, as high as things on it."""
    inside = support.in_table_frame(points_m)
    beside = np.abs(inside[..., :2]) - support.half_size_m
    heights = support.heights(points_m)
    return (beside < MARGIN_M).all(axis=-1) & (heights > LOWEST_M) & (heights < HIGHEST_M)


def pieces_on(
    supports: Sequence[SupportPlane], points_m: NDArray[np.float64], surface: NDArray[np.bool_]
) -> Pieces:
    """The pieces of an image's points (H, W, 3) beside the supports' surfaces (H, W)."""
    heights_m = np.stack([one.heights(points_m) for one in supports])
    inside = np.stack([one.covers(one.in_table_frame(points_m)) for one in supports])
    lies_in = inside & (np.abs(heights_m) < LOWEST_M)
    shown = (points_m[..., 2] != NO_RETURN) & ~surface & ~lies_in.any(axis=0)

    def near(one: tuple[slice, ...], other: tuple[slice, ...]) -> NDArray[np.bool_]:
        return np.linalg.norm(points_m[one] - points_m[other], axis=-1) < SAME_SURFACE_M

    number = connected(shown, near)
    count = int(number.max(initial=-1)) + 1
    over = np.stack([is_over(one, points_m) for one in supports])
    owner = np.where(over.any(axis=0), np.where(over, heights_m, np.inf).argmin(axis=0), -1)
    under = (inside & (heights_m < -LOWEST_M)).any(axis=0)
    pixels = np.bincount(number[shown], minlength=count)
    owned = np.stack(
        [np.bincount(number[shown & (owner == one)], minlength=count) for one in range(-1, len(supports))]
    )
    support = np.where(owned[1:].sum(axis=0) > 0, owned[1:].argmax(axis=0), -1)
    out_of_reach = owned[0] > FURNITURE_SHARE * pixels
    hidden = np.bincount(number[shown & under], minlength=count) > FURNITURE_SHARE * pixels
    sides_m = _sides(points_m, number, count)
    board = (sides_m[:, 0] < BOARD_M) & (sides_m[:, 1] > 2 * NARROWEST_HALF_M)
    board &= sides_m[:, 2] > 2 * SHORTEST_HALF_M
    furniture = out_of_reach | hidden | board
    return Pieces(number, support, furniture, np.linalg.norm(sides_m, axis=1), pixels)


def connected(
    shown: NDArray[np.bool_],
    is_joined: Callable[[tuple[slice, ...], tuple[slice, ...]], NDArray[np.bool_]],
) -> NDArray[np.intp]:
    """The piece (H, W) of each pixel that is shown (H, W), -1 elsewhere.

    Args:
        shown: which pixels belong to pieces.
        is_joined: which pixels of one part of the image belong to the piece of their neighbours in the other.
    """
    places = np.cumsum(shown).reshape(shown.shape) - 1
    ends = []
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1, :], np.s_[1:, :])):
        joined = shown[one] & shown[other] & is_joined(one, other)
        ends.append((places[one][joined], places[other][joined]))
    rows, columns = (np.concatenate(each) for each in zip(*ends, strict=True))
    count = int(shown.sum())
    edges = coo_array((np.ones(len(rows), bool), (rows, columns)), shape=(count, count))
    number = np.full(shown.shape, -1, np.intp)
    number[shown] = connected_components(edges, directed=False)[1]
    return number


def _sides(points_m: NDArray[np.float64], number: NDArray[np.intp], count: int) -> NDArray[np.float64]:
    """Sides (P, 3) of cuboids that are spread like the pieces, the shortest first: sqrt(12) deviations."""
    shown = number >= 0
    which, places = number[shown], points_m[shown]
    pixels = np.maximum(np.bincount(which, minlength=count), 1)
    middles = np.stack([np.bincount(which, places[:, axis], count) for axis in range(3)], axis=1)
    offset = places - (middles / pixels[:, None])[which]
    spread = np.empty((count, 3, 3))
    for row, column in np.ndindex(3, 3):
        spread[:, row, column] = np.bincount(which, offset[:, row] * offset[:, column], count) / pixels
    return np.sqrt(12 * np.maximum(np.linalg.eigvalsh(spread), 0))
