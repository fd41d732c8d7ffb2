"""The sensor's static distortion field, 1/z_measured = 1/z + d(u, v), on a canvas: linear in its nodes.

The nodes are those of `recordings.distortion_field`. A priori they are independent with known standard
deviations, given that their mean is zero: d = `node_factor` @ unit Gaussian coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from recordings.distortion_field import NODE_COLUMNS, NODE_ROWS, pixel_weights
from slam.keyframes.depth_view import CanvasView, framing

NODES = NODE_ROWS * NODE_COLUMNS


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NodeWeights:
    """How pixels of a canvas follow the nodes: the product of a row's and a column's weights.

    Attributes:
        rows: (H, `NODE_ROWS`).
        columns: (W, `NODE_COLUMNS`).
    """

    rows: jax.Array
    columns: jax.Array

    @classmethod
    def of(cls, view: CanvasView) -> NodeWeights:
        """Of a view, whose image may be smaller than the canvas."""
        width, height = framing(view)[4:].astype(int).tolist()
        return _weights_of(width, height, view.depth_m.shape)

    def at(self, pixel: jax.Array) -> jax.Array:
        """Weights (NODES, n) at flat indices (n,) of the canvas."""
        row, column = jnp.divmod(pixel, len(self.columns))
        return node_products(self.rows[row].T, self.columns[column].T)

    def field(self, disparity_per_m: jax.Array) -> jax.Array:
        """The field (H, W) of nodes (NODES,)."""
        return self.rows @ disparity_per_m.reshape(NODE_ROWS, NODE_COLUMNS) @ self.columns.T


@lru_cache(maxsize=16)
def _weights_of(width: int, height: int, canvas: tuple[int, int]) -> NodeWeights:
    """Of an image in the corner of a canvas; beyond the image those of its edge."""
    weights = [
        jnp.asarray(np.pad(of_image, ((0, side - len(of_image)), (0, 0)), mode="edge"), jnp.float32)
        for side, of_image in zip(canvas, pixel_weights(width, height), strict=True)
    ]
    return NodeWeights(*weights)


def node_products(rows: jax.Array, columns: jax.Array) -> jax.Array:
    """Weights (NODES, n) of pixels with rows' (`NODE_ROWS`, n) and columns' (`NODE_COLUMNS`, n)."""
    return (rows[:, None] * columns[None]).reshape(NODES, -1)


def node_factor(sd_per_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """A (NODES, NODES - 1), A A^T the covariance of nodes of deviations (rows, columns) and mean zero.

    The mean is next to the sensor's scale, which nothing in a recording tells.
    """
    deviations = sd_per_m.ravel()
    return deviations[:, None] * null_space(deviations[None])


@dataclass(frozen=True, kw_only=True)
class Distortion:
    """The sensor's distortion field, in coordinates that are independent unit Gaussians a priori.

    Attributes:
        factor: (NODES, F) of `node_factor`.
        coordinates: (F,).
        removed_per_m: (NODES,) the field that the images have been corrected by.
    """

    factor: NDArray[np.float64]
    coordinates: NDArray[np.float64]
    removed_per_m: NDArray[np.float64]

    @classmethod
    def unknown(cls, sd_per_m: NDArray[np.float64]) -> Distortion:
        """None, as the prior has it on average; deviations (rows, columns) of its nodes."""
        factor = node_factor(sd_per_m)
        return cls(factor=factor, coordinates=np.zeros(factor.shape[1]), removed_per_m=np.zeros(len(factor)))

    @property
    def disparity_per_m(self) -> NDArray[np.float64]:
        """(NODES,) what the images still have of it."""
        return self.factor @ self.coordinates - self.removed_per_m

    def removed(self) -> Distortion:
        """The same for images that have been corrected by it."""
        return replace(self, removed_per_m=self.factor @ self.coordinates)

    def moved(self, step: NDArray[np.float64]) -> Distortion:
        """The field a step (F,) further."""
        return replace(self, coordinates=self.coordinates + step)
