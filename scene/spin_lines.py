"""The lines about which objects spin by themselves, for moves of their poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from scene.scene_object import SceneObject


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SpinLines:
    """A line for each of C bodies, in its box frame.

    Attributes:
        directions: (C, 3) units, 0 where a body has none.
        points_m: (C, 3) on the lines, 0 where there is none.
    """

    directions: jax.Array
    points_m: jax.Array

    @classmethod
    def none(cls, bodies: int) -> SpinLines:
        """No body has one."""
        return cls(jnp.zeros((bodies, 3)), jnp.zeros((bodies, 3)))

    @classmethod
    def of(cls, objects: Sequence[SceneObject], spare: int) -> SpinLines:
        """Those of objects, and of as many bodies more that have none."""
        lines = np.stack([one.spin_line for one in objects] + [np.zeros((2, 3))] * spare)
        return cls(jnp.asarray(lines[:, 0]), jnp.asarray(lines[:, 1]))
