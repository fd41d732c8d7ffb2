"""Chains whose likelihood is estimated over random shapes have the exact posterior (supplement N)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pipeline.benchmarks.cubes import cube_kernel, cube_model, start_chains
from scene.likelihood.shape_draws import draw_shapes, redraw_shapes
from scene.mcmc.kernel import run_block
from scene.model.posterior import ChainState, Estimate, SeparateLikelihoods
from scene.model.scene_graph import SceneGraph
from tests.statistical import assert_mean

CHAINS, SWEEPS, BURN_IN = 256, 160, 40
SHAPES = 8
"""Three voxels, each there or not: all 2^3 shapes are alike before the data."""
VOXEL_NATS = np.array([[0.3, -0.4, 0.2], [2.2, -1.8, 1.6]])
"""What each voxel adds to the log likelihood where the cube stands left, or right, of x = 0."""
SIDES = VOXEL_NATS @ ((np.arange(SHAPES)[None] >> np.arange(3)[:, None]) & 1) - np.array([[0.0], [2.0]])
RIGHT = 1 / (1 + np.exp(SIDES[0]).mean() / np.exp(SIDES[1]).mean())


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ThreeVoxels(SeparateLikelihoods):
    """The estimate over R shapes, or one of two that are wrong."""

    depends_on_graph: ClassVar[bool] = False
    fresh_share: jax.Array
    draws: int = field(metadata={"static": True})
    wrong: str = field(default="", metadata={"static": True})

    def estimate(self, pose: jax.Array, shapes: jax.Array) -> Estimate:
        """Of the shapes (R,) at a pose."""
        logs = jnp.asarray(SIDES)[(pose[4] > 0).astype(jnp.int32), shapes]
        log_mean = jax.scipy.special.logsumexp(logs) - np.log(self.draws)
        return Estimate(jnp.mean(logs) if self.wrong == "mean of logs" else log_mean, shapes)

    def start(self, key: jax.Array, scene: SceneGraph) -> Estimate:
        """From fresh shapes."""
        return self.estimate(scene.poses[0], draw_shapes(key, (self.draws,), SHAPES))

    def offered(
        self, keys: jax.Array, scenes: SceneGraph, moved: jax.Array, current: Estimate, *, anew: jax.Array
    ) -> Estimate:
        """From shapes redrawn where the cube has moved, or where it should not be."""
        del anew

        def one(place: jax.Array, keys: jax.Array, pose: jax.Array, moved: jax.Array) -> Estimate:
            fresh = redraw_shapes(keys, current.draws, SHAPES, self.fresh_share)
            stays = ~moved & ((place > 0) | (self.wrong != "recomputed"))
            return self.estimate(pose, jnp.where(stays, current.draws, fresh))

        return jax.vmap(one)(jnp.arange(len(keys)), keys, scenes.poses[:, 0], moved[:, 0])


def is_right(state: ChainState) -> jax.Array:
    """Whether the cube stands right of x = 0."""
    return (state.scene.poses[0, 4] > 0).astype(jnp.float64)


def shares_right(key: jax.Array, draws: int, share: float, wrong: str = "") -> np.ndarray:
    """Share of the sweeps of each chain (CHAINS, 1) that end on the right."""
    start_key, run_key = jax.random.split(key)
    kernel = replace(cube_kernel(1, candidates=4), structure=None)
    model = cube_model(1, likelihood=ThreeVoxels(jnp.asarray(share), draws, wrong))
    states = start_chains(start_key, model, CHAINS)
    _, recorded, _ = run_block(run_key, states, model, kernel, SWEEPS, is_right)
    return np.asarray(recorded)[BURN_IN:].mean(axis=0)[:, None]


def test_shapes_tell_the_sides_apart() -> None:
    """The log likelihood of one shape varies by a nat or more on one side, less on the other."""
    spread = SIDES.std(axis=1)
    assert spread[1] > 1 > 3 * spread[0]


@pytest.mark.parametrize("share", [1.0, 0.3])
@pytest.mark.parametrize(
    "draws", [4, pytest.param(1, marks=pytest.mark.slow), pytest.param(16, marks=pytest.mark.slow)]
)
def test_the_posterior_is_exact_for_any_number_of_draws(key: jax.Array, draws: int, share: float) -> None:
    """All choices fresh, or a share of them (the correlated form): the exact share; 1e-6 false alarms."""
    assert_mean(shares_right(key, draws, share), [RIGHT], detectable=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "draws", "share"),
    [("recomputed", 1, 1.0), ("recomputed", 4, 1.0), ("mean of logs", 4, 1.0), ("", 1, 0.0)],
)
def test_wrong_estimates_are_told(key: jax.Array, wrong: str, draws: int, share: float) -> None:
    """A recomputed present estimate, a mean of logs and a shape that stays the same: another posterior."""
    shares = shares_right(key, draws, share, wrong)
    with pytest.raises(AssertionError, match="mean is off"):
        assert_mean(shares, [RIGHT], detectable=0.1)
