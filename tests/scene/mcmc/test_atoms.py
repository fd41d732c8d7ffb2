"""Atoms from masks as a part of the chains' proposals: their weights, their density, and what chains return.

A proposal is right if its density is that of its draws, whatever data the atoms come from: with the
likelihood constant, chains return the prior. Three mutants do not, and are tested to be seen: the density
without the atoms' share, atoms that depend on where the object is, and atoms that it takes for wider.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pipeline.benchmarks.cubes import cube_kernel, cube_model, start_chains
from scene.masks.convolution import FlatGrid, scores_in
from scene.masks.grid import FREE, STEPS, EvidenceGrid
from scene.masks.proposal import log_boltzmann
from scene.masks.shape_masks import MOST_CELLS, ShapeMasks
from scene.mcmc import mixture_init, pose_mixture
from scene.mcmc.independence_multiple_try import IndependenceMultipleTry
from scene.mcmc.involution import CandidateSet
from scene.mcmc.kernel import Kernel, run_block
from scene.mcmc.mixture_init import ATOMS_SHARE, with_atoms
from scene.mcmc.pose_mixture import PoseMixture
from scene.mcmc.random_variates import Variates
from scene.mcmc.walks import WalkMove
from scene.model.posterior import ChainState, SceneModel
from scene.model.scene_graph import ROOT
from shapes.geometry.rotation_densities import uniform_rotation
from tests.scene.mcmc.tree_frequencies import tree_frequencies
from tests.statistical import assert_frequencies, assert_mean

HERE = jnp.array([1.0, 0, 0, 0, 0, 0, 0])
SIGMA_M, SIGMA_RAD = 0.2, 1.0
"""Of atoms among cubes of a metre."""


def test_boltzmann_agrees_with_enumeration(seed: int) -> None:
    """8^3 cells x 24 orientations: scores of masks, p in proportion to exp(beta score) for one beta."""
    rng = np.random.default_rng(seed)
    grid = EvidenceGrid(
        evidence=rng.choice(np.array([STEPS, -FREE, 0], np.int8), (8, 8, 8)),
        pitch_m=0.01,
        camera_from_grid=np.eye(4),
    )
    masks = ShapeMasks(
        rotations=np.tile(np.eye(3, dtype=np.float32), (24, 1, 1)),
        offsets=rng.integers(-2, 3, (24, MOST_CELLS, 3)).astype(np.int8),
        weights=rng.choice(np.array([2, -1], np.int8), (24, MOST_CELLS)),
    )
    cells = np.stack(np.meshgrid(*3 * [np.arange(8)], indexing="ij"), axis=-1).reshape(1, -1, 3)
    flat = FlatGrid.of(grid.evidence, 2)
    scores = scores_in(flat, masks, np.arange(24), np.repeat(cells, 24, axis=0)).ravel()

    log_p = log_boltzmann(scores, 64.0)

    beta = (log_p.max() - log_p.min()) / (scores.max() - scores.min())
    expected = np.exp(beta * scores.astype(float)) / np.exp(beta * scores.astype(float)).sum()
    np.testing.assert_allclose(np.exp(log_p), expected, rtol=1e-6)
    assert 1 / (expected**2).sum() == pytest.approx(64.0, rel=1e-6)


def test_boltzmann_from_uniform_to_the_best() -> None:
    """Fewer atoms than asked for are all as likely; one effective atom is the best, ties are shared."""
    np.testing.assert_allclose(np.exp(log_boltzmann(np.array([0.1, 0.9, 0.4]), 64.0)), 1 / 3, rtol=1e-6)
    best = np.exp(log_boltzmann(np.array([0.1, 0.9, 0.4, 0.9]), 1.0))
    np.testing.assert_allclose(best, [0, 0.5, 0, 0.5], atol=1e-12)


def atoms_mixture(count: int, log_weights: jax.Array, centres: jax.Array, sigma: float = 1.0) -> PoseMixture:
    """One wide component for each of `count` bodies, and the same atoms (A,) and (A, 7) for each."""
    wide = jnp.diag(jnp.array([0.3, 0.3, 0.3, 1.0, 1.0, 1.0]) ** 2)
    mixture = PoseMixture.build(
        jnp.zeros((count, 1)), jnp.tile(HERE, (count, 1, 1)), jnp.tile(wide, (count, 1, 1, 1))
    )
    poses, weights = (jnp.broadcast_to(leaf, (count, *leaf.shape)) for leaf in (centres, log_weights))
    return with_atoms(mixture, HERE, poses, weights, sigma * SIGMA_M, sigma * SIGMA_RAD)


def some_atoms(seed: int, count: int = 12) -> tuple[jax.Array, jax.Array]:
    """Boltzmann weights and poses at least 0.3 m from each other, as of a cloud on one side."""
    rng = np.random.default_rng(seed)
    places = np.stack(np.meshgrid([0.1, 0.4, 0.7], [0.0, 0.4], [-0.3, 0.3], indexing="ij"), -1).reshape(-1, 3)
    turns = rng.normal(size=(count, 4))
    poses = np.concatenate([turns / np.linalg.norm(turns, axis=1, keepdims=True), places[:count]], axis=1)
    return jnp.asarray(log_boltzmann(rng.uniform(0, 1, count), 8.0)), jnp.asarray(poses)


def test_draws_fall_on_atoms_as_often_as_their_weights_say(key: jax.Array, seed: int) -> None:
    """A million draws (chi-square, false alarm 1e-6): by the nearest atom, the wide component apart."""
    log_weights, centres = some_atoms(seed)
    mixture = atoms_mixture(1, log_weights, centres, sigma=1e-3).of(jnp.asarray(0))
    uniform_key, normal_key = jax.random.split(key)
    uniforms, normals = jax.random.uniform(uniform_key, (10**6,)), jax.random.normal(normal_key, (10**6, 6))

    @jax.jit
    def nearest(uniforms: jax.Array, normals: jax.Array) -> jax.Array:
        def one(uniform: jax.Array, normal: jax.Array) -> jax.Array:
            pose = pose_mixture.sample(uniform, normal, mixture)
            distance = jnp.linalg.norm(pose[None, 4:] - centres[:, 4:], axis=1)
            return jnp.where(jnp.min(distance) < 1e-3, jnp.argmin(distance), len(centres))

        return jax.lax.map(lambda both: jax.vmap(one)(*both), (uniforms, normals))

    places = nearest(uniforms.reshape(100, -1), normals.reshape(100, -1, 6))

    expected = np.append(ATOMS_SHARE * np.exp(log_weights), 1 - ATOMS_SHARE)
    assert_frequencies(np.bincount(np.asarray(places).ravel(), minlength=len(expected)), expected)


def test_the_density_integrates_to_one(key: jax.Array, seed: int) -> None:
    """Over a cuboid that holds nearly all places x turns of mass pi^2, by 400,000 even points."""
    log_weights, centres = some_atoms(seed)
    mixture = atoms_mixture(1, log_weights, centres).of(jnp.asarray(0))
    low, high = jnp.array([-1.6, -1.6, -1.6]), jnp.array([2.0, 1.8, 1.7])

    @jax.jit
    def densities(uniforms: jax.Array) -> jax.Array:
        def one(uniform: jax.Array) -> jax.Array:
            place = low + uniform[3:] * (high - low)
            return jnp.exp(
                pose_mixture.log_density(mixture, jnp.concatenate([uniform_rotation(uniform[:3]), place]))
            )

        return jax.lax.map(jax.vmap(one), uniforms)

    values = densities(jax.random.uniform(key, (100, 4000, 6))) * jnp.prod(high - low) * jnp.pi**2

    assert_mean(np.asarray(values).ravel(), 1.0, detectable=0.15)


def far_alone(kernel: Kernel, mixture: PoseMixture) -> Kernel:
    """The moves that draw from a mixture, and walks so small that they do not hide these."""
    (walk,) = (move for move in kernel.others if isinstance(move, WalkMove))
    still = replace(walk, translation_m=1e-6 * walk.translation_m, rotation_rad=1e-6 * walk.rotation_rad)
    far = replace(kernel.candidates[0], mixture=mixture)
    return replace(kernel, structure=None, candidates=(far,), others=(still,))


def first_place(state: ChainState) -> jax.Array:
    """Where the first object is (3,), and the squares of that."""
    place = state.scene.poses[0, 4:]
    return jnp.concatenate([place, place**2])


def visited(key: jax.Array, seed: int) -> np.ndarray:
    """Means (chains, 6) over sweeps of `first_place` of one cube whose far moves know of atoms."""
    model = cube_model(1)
    kernel = cube_kernel(1, prior_share=0.05)
    kernel = far_alone(kernel, atoms_mixture(1, *some_atoms(seed)))
    start_key, run_key = jax.random.split(key)
    states = start_chains(start_key, model, 256)
    _, places, _ = run_block(run_key, states, model, kernel, 80, first_place)
    return np.asarray(places)[30:].mean(axis=0)


PRIOR = [0.0, 0.0, 0.0, *3 * [0.75**2 / 3]]
"""Mean and mean square of a place that is even in (1.5 m)^3."""


def test_without_data_chains_return_the_prior(key: jax.Array, seed: int) -> None:
    """However the atoms lie: the floating cube is anywhere in its cuboid."""
    assert_mean(visited(key, seed), PRIOR, detectable=0.12)


def _without_atoms(density: Callable, mixture: PoseMixture, pose: jax.Array) -> jax.Array:
    log_weights = jnp.where(jnp.arange(len(mixture.log_weights)) == 0, mixture.log_weights, -jnp.inf)
    return density(replace(mixture, log_weights=log_weights), pose)


def _wider(density: Callable, mixture: PoseMixture, pose: jax.Array) -> jax.Array:
    return density(replace(mixture, whitenings=0.4 * mixture.whitenings), pose)


@pytest.mark.slow
@pytest.mark.parametrize("mutant", [_without_atoms, _wider])
def test_a_density_that_is_not_of_the_draws_is_seen(
    key: jax.Array, seed: int, mutant: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mutants' chains do not return the prior."""
    monkeypatch.setattr(pose_mixture, "log_density", partial(mutant, pose_mixture.log_density))
    jax.clear_caches()

    means = visited(key, seed)

    jax.clear_caches()
    with pytest.raises(AssertionError, match="mean is off"):
        assert_mean(means, PRIOR, detectable=0.12)


@pytest.mark.slow
def test_a_grid_that_holds_the_moved_object_is_seen(
    key: jax.Array, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Atoms are right where they always are, and wrong where they are there only while the object is near."""
    offer = IndependenceMultipleTry.propose

    def own_cells(
        self: IndependenceMultipleTry, model: SceneModel, dice: Variates, state: ChainState
    ) -> CandidateSet:
        log_weights = self.mixture.log_weights
        alone = jnp.where(jnp.arange(log_weights.shape[1]) == 0, 0.0, -jnp.inf)
        is_near = state.scene.poses[0, 4] > 0
        mixture = replace(self.mixture, log_weights=jnp.where(is_near, log_weights, alone[None]))
        return offer(replace(self, mixture=mixture), model, dice, state)

    right_key, wrong_key = jax.random.split(key)
    monkeypatch.setattr(mixture_init, "ATOMS_SHARE", 0.5)
    jax.clear_caches()
    right = visited(right_key, seed)
    monkeypatch.setattr(IndependenceMultipleTry, "propose", own_cells)
    jax.clear_caches()

    wrong = visited(wrong_key, seed)

    jax.clear_caches()
    assert_mean(right, PRIOR, detectable=0.12)
    with pytest.raises(AssertionError, match="mean is off"):
        assert_mean(wrong, PRIOR, detectable=0.12)


@pytest.mark.slow
def test_without_data_the_graph_returns_its_prior(key: jax.Array, seed: int) -> None:
    """Graph sampling on: two cubes both float in a third of the sweeps."""
    kernel = cube_kernel(2)
    kernel = kernel.with_mixture(atoms_mixture(2, *some_atoms(seed)))

    frequencies, trees = tree_frequencies(key, cube_model(2), kernel, chains=256, sweeps=200, burn_in=60)

    assert_mean(frequencies[:, (trees == ROOT).all(axis=1)], [1 / 3], detectable=0.06)
