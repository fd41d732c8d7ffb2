"""A number for every tree, in place of p(G) or of the likelihood: what the sampler is proved right with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from scene.model.posterior import Estimate, SeparateLikelihoods
from scene.model.scene_graph import SceneGraph, tree_code


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GraphTable(SeparateLikelihoods):
    """log p(G) or log p(data | G) by enumeration; serves as `StructurePrior` and as `Likelihood`.

    Attributes:
        log_values: ((C+1)^C,) by `tree_code`; -inf where no tree has the code.
    """

    depends_on_graph: ClassVar[bool] = True
    log_values: jax.Array

    @classmethod
    def build(cls, trees: NDArray[np.int32], log_values: ArrayLike) -> GraphTable:
        """The table with these values (T,) for `trees` (T, C)."""
        capacity = trees.shape[1]
        values = np.full((capacity + 1) ** capacity, -np.inf)
        values[np.asarray(jax.vmap(tree_code)(jnp.asarray(trees)))] = log_values
        return cls(jnp.asarray(values))

    def log_density(self, parents: jax.Array, present: jax.Array, movable: jax.Array) -> jax.Array:  # noqa: ARG002
        """Log p(G)."""
        return self.log_values[tree_code(parents)]

    def log_floating_odds(self) -> jax.Array:
        """None: acceptance alone knows the table."""
        return jnp.zeros((), self.log_values.dtype)

    def start(self, key: jax.Array, scene: SceneGraph) -> Estimate:  # noqa: ARG002
        """Log p(data | G)."""
        return Estimate(self.log_values[tree_code(scene.parents)], ())

    def offered(
        self,
        keys: jax.Array,  # noqa: ARG002
        scenes: SceneGraph,
        moved: jax.Array,  # noqa: ARG002
        current: Estimate,  # noqa: ARG002
        *,
        anew: jax.Array,  # noqa: ARG002
    ) -> Estimate:
        """The same of each."""
        return Estimate(self.log_values[jax.vmap(tree_code)(scenes.parents)], ())
