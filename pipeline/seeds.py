"""The keys of the stages, from one seed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, get_args

if TYPE_CHECKING:
    import jax

Stage = Literal["slam", "learn", "parse", "draws"]
STAGES: tuple[Stage, ...] = get_args(Stage)
"""In the order in which the root key is split; new stages go to the end."""


def stage_key(seed: int, stage: Stage) -> jax.Array:
    """The key of a stage."""
    import jax

    return jax.random.split(jax.random.key(seed), len(STAGES))[STAGES.index(stage)]
