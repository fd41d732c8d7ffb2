"""The production kernel with data that see a pose: against evidences from prior draws.

As docs/model.md, sections O and K.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pipeline.benchmarks.cubes import cube_kernel, cube_model, floating_draw, start_chains
from scene.mcmc.kernel import Kernel, run_block
from scene.mcmc.local_multiple_try import LocalMultipleTry
from scene.mcmc.symmetry_arrays import SpinLines, Symmetries
from scene.model.contact import TOP_FACE
from scene.model.posterior import ChainState, Estimate, SceneModel, SeparateLikelihoods
from scene.model.prior import sample_pose
from scene.model.scene_graph import ROOT, SceneGraph
from tests.statistical import assert_mean

CHAINS, SWEEPS, BURN_IN = 256, 160, 40
PRIOR_DRAWS = 1_000_000
PLACE_M = jnp.array([0.3, -0.2, 0.6])
SIGMA_M, CONCENTRATION = 0.25, 3.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Seen(SeparateLikelihoods):
    """Of body 0: its place, Gaussian, and the direction of its third axis, von Mises-Fisher."""

    depends_on_graph: ClassVar[bool] = False
    place_m: jax.Array

    def log_likelihood(self, pose: jax.Array) -> jax.Array:
        """Not normalised."""
        _, x, y, _ = pose[:4]
        upright = 1 - 2 * (x * x + y * y)
        off = (pose[4:] - self.place_m) / SIGMA_M
        return -0.5 * jnp.sum(off**2) + CONCENTRATION * upright

    def start(self, key: jax.Array, scene: SceneGraph) -> Estimate:
        """Exact."""
        del key
        return Estimate(self.log_likelihood(scene.poses[0]), ())

    def offered(
        self, keys: jax.Array, scenes: SceneGraph, moved: jax.Array, current: Estimate, *, anew: jax.Array
    ) -> Estimate:
        """Exact."""
        del keys, moved, current, anew
        return Estimate(jax.vmap(self.log_likelihood)(scenes.poses[:, 0]), ())


def seen_model() -> SceneModel:
    """One cube and a table."""
    return cube_model(1, table=True, likelihood=Seen(PLACE_M))


def expected(key: jax.Array, model: SceneModel) -> np.ndarray:
    """P(contact), and the posterior means of height and uprightness, by weighted prior draws."""
    likelihood = model.likelihood
    assert isinstance(likelihood, Seen)
    scene_key, floating_key, contact_key = jax.random.split(key, 3)
    floating = floating_draw(scene_key, model)
    resting = replace(
        floating,
        parents=jnp.array([1, ROOT], jnp.int32),
        parent_faces=jnp.array([TOP_FACE, 0], jnp.int32),
    )

    def weighted(scene: SceneGraph, key: jax.Array) -> jax.Array:
        face_key, pose_key = jax.random.split(key)
        faces = scene.child_faces.at[0].set(jax.random.randint(face_key, (), 0, 6, jnp.int32))
        uniforms = jax.random.uniform(pose_key, (9,))
        pose = sample_pose(
            uniforms, model.prior, model.bodies, replace(scene, child_faces=faces), jnp.array(0)
        )
        features = jnp.array([1.0, pose[6], 1 - 2 * (pose[1] ** 2 + pose[2] ** 2)])
        return jnp.exp(likelihood.log_likelihood(pose)) * features

    sums = [
        jax.lax.map(partial(weighted, scene), jax.random.split(draws, PRIOR_DRAWS), batch_size=20_000).mean(0)
        for scene, draws in ((floating, floating_key), (resting, contact_key))
    ]
    evidence = sums[0][0] + sums[1][0]
    return np.array([sums[1][0], *(sums[0] + sums[1])[1:]]) / float(evidence)


def features(state: ChainState) -> jax.Array:
    """Whether the cube rests on the table, its height and how upright it is."""
    pose = state.scene.poses[0]
    on_table = (state.scene.parents[0] != ROOT).astype(pose.dtype)
    return jnp.array([on_table, pose[6], 1 - 2 * (pose[1] ** 2 + pose[2] ** 2)])


LINES = SpinLines(
    jnp.array([[0.8, 0.6, 0], [0, 0, 0]]), jnp.array([[0.1, -0.2, 0.3], [0, 0, 0]]), jnp.zeros(2, bool)
)
TURNS = Symmetries(
    jnp.array([[[0.8, 0.6, 0], [0, 0, 1.0], [1.0, 0, 0]], [[0, 0, 0.0]] * 3]),
    jnp.array([[[0.1, -0.2, 0.3], [0.2, 0, 0], [0, 0, 0]], [[0, 0, 0.0]] * 3]),
    jnp.array([[2, 4, 0], [0, 0, 0]]),
)


def far_only(kernel: Kernel) -> Kernel:
    """Candidates wherever the object is."""
    return replace(kernel, candidates=kernel.candidates[:1])


def near_only(kernel: Kernel) -> Kernel:
    """Candidates round the present pose, some spun or turned."""
    near = kernel.candidates[1]
    assert isinstance(near, LocalMultipleTry)
    return replace(kernel, candidates=(replace(near, lines=LINES, symmetries=TURNS),))


def both(kernel: Kernel) -> Kernel:
    """In turn."""
    return kernel


@pytest.mark.parametrize(
    "chosen",
    [both, pytest.param(far_only, marks=pytest.mark.slow), pytest.param(near_only, marks=pytest.mark.slow)],
)
def test_contact_is_as_likely_as_its_evidence(key: jax.Array, chosen: Callable[[Kernel], Kernel]) -> None:
    """P(contact) and two means, by all ways to choose candidates: within 1e-6 false alarms."""
    model = seen_model()
    start_key, run_key, exact_key = jax.random.split(key, 3)
    kernel = chosen(cube_kernel(2, candidates=4))
    states = start_chains(start_key, model, CHAINS)

    _, recorded, accepted = run_block(run_key, states, model, kernel, SWEEPS, features)

    assert 0.1 < float(jnp.mean(accepted[..., :-1])) < 0.9
    assert_mean(np.asarray(recorded)[BURN_IN:].mean(axis=0), expected(exact_key, model), detectable=0.03)
