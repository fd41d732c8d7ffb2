"""Kept samples of chains over scene graphs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import NDArray


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Samples:
    """Kept states of chains: (S, chains, ...) of whole runs, any leading axes before.

    Attributes:
        poses: (..., C, 7) world_from_box.
        parents: (..., C).
        parent_faces: (..., C).
        child_faces: (..., C).
        log_posterior: (...).
        accepted: (...) share of the moves of poses before it that were accepted.
    """

    poses: NDArray[np.float64]
    parents: NDArray[np.int32]
    parent_faces: NDArray[np.int32]
    child_faces: NDArray[np.int32]
    log_posterior: NDArray[np.float64]
    accepted: NDArray[np.float64]

    @classmethod
    def joined(cls, blocks: Sequence[Samples]) -> Samples:
        """Blocks (count, chains, ...) after one another."""
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *blocks)
