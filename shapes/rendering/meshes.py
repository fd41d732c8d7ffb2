"""Closed triangle meshes as they are rasterised: planes, edges, and many of them in arrays of one shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Mesh:
    """Closed triangles.

    Attributes:
        vertices_m: (V, 3).
        faces: (F, 3), counter-clockwise from outside.
    """

    vertices_m: NDArray[np.float64]
    faces: NDArray[np.int64]

    @cached_property
    def normals(self) -> NDArray[np.float64]:
        """Normals (F, 3) to the outside, twice as long as the triangles are large."""
        corner = self.vertices_m[self.faces]
        return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])

    @cached_property
    def offsets(self) -> NDArray[np.float64]:
        """Of the triangles' planes (F,): n . x."""
        return (self.normals * self.vertices_m[self.faces[:, 0]]).sum(axis=1)

    @cached_property
    def edges(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Vertices (E, 2), and the triangles (E, 2) that run along them and against; F for none."""
        _, first, same = np.unique(self.vertices_m, axis=0, return_index=True, return_inverse=True)
        faces = first[same.ravel()][self.faces]
        ends = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        against = (ends[:, 0] > ends[:, 1]).astype(np.int64)
        key = np.sort(ends, axis=1) @ np.array([len(self.vertices_m), 1])
        pairs = np.stack([key, _ranks(2 * key + against)], axis=1)
        unique, number = np.unique(pairs, axis=0, return_inverse=True)
        triangles = np.full((len(unique), 2), len(faces))
        triangles[number.ravel(), against] = np.repeat(np.arange(len(faces)), 3)
        return np.stack(np.divmod(unique[:, 0], len(self.vertices_m)), axis=1), triangles


@dataclass(frozen=True, eq=False)
class MeshSet:
    """Meshes (M,) in arrays of one shape, so that any of them are rendered together.

    Attributes:
        vertices_m: (M, V, 3).
        faces: (M, F, 3).
        normals: (M, F, 3); 0 of triangles that fill up.
        offsets: (M, F) of their planes.
        ends: (M, E, 2) vertices of edges.
        sides: (M, E, 2) triangles along and against them; F where there is none.
    """

    vertices_m: NDArray[np.float64]
    faces: NDArray[np.int64]
    normals: NDArray[np.float64]
    offsets: NDArray[np.float64]
    ends: NDArray[np.int64]
    sides: NDArray[np.int64]

    @classmethod
    def of(cls, meshes: Sequence[Mesh]) -> MeshSet:
        """Fill up."""
        most = max(len(mesh.faces) for mesh in meshes)
        sides = [np.where(mesh.edges[1] == len(mesh.faces), most, mesh.edges[1]) for mesh in meshes]
        return cls(
            vertices_m=_filled_up([mesh.vertices_m for mesh in meshes], 0.0),
            faces=_filled_up([mesh.faces for mesh in meshes], 0),
            normals=_filled_up([mesh.normals for mesh in meshes], 0.0),
            offsets=_filled_up([mesh.offsets for mesh in meshes], 0.0),
            ends=_filled_up([mesh.edges[0] for mesh in meshes], 0),
            sides=_filled_up(sides, most),
        )


def _filled_up(arrays: Sequence[NDArray], value: float) -> NDArray:
    filled = np.full((len(arrays), max(map(len, arrays)), *arrays[0].shape[1:]), value, arrays[0].dtype)
    for row, array in zip(filled, arrays, strict=True):
        row[: len(array)] = array
    return filled


def _ranks(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many equal keys stand before each."""
    order = np.argsort(keys, kind="stable")
    place = np.arange(len(keys))
    first = np.append(True, np.diff(keys[order]) != 0)
    ranks = np.empty(len(keys), np.int64)
    ranks[order] = place - np.maximum.accumulate(np.where(first, place, 0))
    return ranks
