"""Symmetry lines of objects as arrays: continuous rotations, and half or quarter turns, for pose moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from scene.mcmc.random_variates import draw_object
from scene.objects.scene_object import SceneObject


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SpinLines:
    """A line for each of C bodies, in its box frame.

    Attributes:
        directions: (C, 3) units, 0 where a body has none.
        points_m: (C, 3) on the lines, 0 where there is none.
        free: (C,) bool, where no depth tells the spin.
    """

    directions: jax.Array
    points_m: jax.Array
    free: jax.Array

    @property
    def there(self) -> jax.Array:
        """(C,) bool, which bodies have one."""
        return jnp.any(self.directions != 0, axis=-1)

    def of_body(self, body: jax.Array) -> SpinLines:
        """Of one body, (3,) and ()."""
        return SpinLines(self.directions[body], self.points_m[body], self.free[body])

    @classmethod
    def of(cls, objects: Sequence[SceneObject], spare: int) -> SpinLines:
        """Those of objects, and of as many bodies more that have none."""
        lines = np.stack([one.spin_line for one in objects] + [np.zeros((2, 3))] * spare)
        free = np.array([one.spins_freely for one in objects] + [False] * spare)
        return cls(jnp.asarray(lines[:, 0]), jnp.asarray(lines[:, 1]), jnp.asarray(free))


STAYS, HALF = 0.6745, 1.1503
"""Quantiles of |Z|, Z normal: half of all draws stay, and a quarter are over the second."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Symmetries:
    """Three lines for each of C bodies, in its box frame.

    Attributes:
        directions: (C, 3, 3) units.
        points_m: (C, 3, 3) on the lines.
        orders: (C, 3): 2 where half a turn leaves the body nearly as it is, 4 where a quarter does, else 0.
    """

    directions: jax.Array
    points_m: jax.Array
    orders: jax.Array

    @classmethod
    def of(cls, objects: Sequence[SceneObject], spare: int) -> Symmetries:
        """Those of objects, and of as many bodies more that have none."""
        lines = np.stack([one.symmetry_lines for one in objects] + [np.zeros((3, 2, 3))] * spare)
        orders = np.stack([one.symmetry_orders for one in objects] + [np.zeros(3)] * spare)
        return cls(jnp.asarray(lines[:, :, 0]), jnp.asarray(lines[:, :, 1]), jnp.asarray(orders, jnp.int32))

    def drawn(self, body: jax.Array, uniform: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Direction (3,), point (3,) and order of one of a body's lines, each as likely; order 0 without."""
        orders = self.orders[body]
        line = draw_object(orders > 0, uniform)
        return self.directions[body, line], self.points_m[body, line], orders[line]


def symmetry_angle(order: jax.Array, normal: jax.Array) -> jax.Array:
    """Angles of normal numbers (...): none half the time, else half a turn or, of order 4, any quarters."""
    size = jnp.abs(normal)
    quarter = (order == 4) & (size < HALF)
    turned = jnp.where(quarter, jnp.copysign(jnp.pi / 2, normal), jnp.pi)
    return jnp.where((size < STAYS) | (order == 0), 0.0, turned)
