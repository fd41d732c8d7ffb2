"""The move that changes which objects are there: a transition matrix, a world of strips, and no data."""

import itertools
from dataclasses import dataclass, replace
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import comb

from pipeline.benchmarks.cubes import cube_model
from scene.mcmc.birth_proposals import LeafPrior, MixtureBirths
from scene.mcmc.edges import EdgeMove
from scene.mcmc.pair_toggle import ABSENT_POSE, PairToggle
from scene.mcmc.pose_mixture import PoseMixture
from scene.mcmc.presence_chains import PresenceKernel, presence_of, run_presence
from scene.mcmc.random_variates import Variates
from scene.mcmc.walks import WalkMove
from scene.model.counted_trees import CountedTrees, FloatingTrees
from scene.model.number_prior import (
    BinomialNumber,
    FixedNumber,
    NumberPrior,
    PoissonNumber,
    UncertainBinomialNumber,
)
from scene.model.posterior import ChainState, Estimate, SceneModel, SeparateLikelihoods, start_chain
from scene.model.prior import WeightedTrees
from scene.model.scene_graph import SceneGraph, floating_scene
from tests.statistical import assert_mean

PLACES = 3


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ListedPlaces:
    """Poses at x = 0, 1, 2; the first uniform number says which. Their densities differ by slot."""

    log_chances: jax.Array

    @property
    def uniforms(self) -> int:
        """One."""
        return 1

    @property
    def normals(self) -> int:
        """None."""
        return 0

    def sample(self, dice: Variates, model: SceneModel, scene: SceneGraph, slot: jax.Array) -> jax.Array:  # noqa: ARG002
        """The place whose number was thrown."""
        return jnp.array([1.0, 0, 0, 0, 0, 0, 0]).at[4].set(jnp.floor(dice.uniform[0]))

    def log_density(
        self,
        model: SceneModel,  # noqa: ARG002
        scene: SceneGraph,  # noqa: ARG002
        slot: jax.Array,
        pose: jax.Array,
    ) -> jax.Array:
        """Of that place."""
        return self.log_chances[slot, pose[4].astype(int)]


def toy_states() -> list[SceneGraph]:
    """Neither, the first at each of three places, the second at each: seven."""
    absent = jnp.asarray(ABSENT_POSE)
    states = [floating_scene(jnp.stack([absent, absent]), jnp.zeros(2, bool))]
    for slot, place in itertools.product(range(2), range(PLACES)):
        poses = jnp.stack([absent, absent]).at[slot, 4].set(place)
        states.append(floating_scene(poses, jnp.arange(2) == slot))
    return states


def number_of(scene: SceneGraph) -> int:
    """Which of the seven."""
    if not bool(scene.present.any()):
        return 0
    slot = int(scene.present[1])
    return 1 + slot * PLACES + int(scene.poses[slot, 4])


def toy_matrix(target: np.ndarray, toggle: PairToggle) -> np.ndarray:
    """Transition matrix (7, 7) of the toggle with Metropolised choice: the sum over all draws of poses."""
    assert isinstance(toggle.births, ListedPlaces)
    chances = np.exp(np.asarray(toggle.births.log_chances))
    model = cube_model(2)
    matrix = np.zeros((7, 7))
    draws = list(itertools.product(range(PLACES), repeat=2 * toggle.count))
    thrown = jnp.asarray(draws, float).reshape(len(draws), 2, toggle.count, 1)
    edges = jnp.zeros((len(draws), 2, toggle.count, 1))
    offers_of = jax.jit(
        lambda state: jax.vmap(
            lambda uniform: toggle.options(
                jnp.array([0, 1]), Variates(uniform, jnp.zeros((2, toggle.count, 0))), model, state
            )
        )(jnp.concatenate([edges, thrown], axis=-1))
    )
    for row, scene in enumerate(toy_states()):
        state = ChainState(scene, jnp.zeros(()), Estimate(jnp.zeros(()), ()))
        offers = jax.tree.map(np.asarray, offers_of(state))
        for at, draw in enumerate(draws):
            first, second = np.array(draw).reshape(2, toggle.count)
            held = [first, second]
            probability = 1.0
            for slot in range(2):
                free = held[slot][1:] if scene.present[slot] else held[slot]
                probability *= chances[slot, free].prod()
            if any(bool(scene.present[slot]) and held[slot][0] != 0 for slot in range(2)):
                continue  # the first throw is not used: count one of its values
            options = [
                number_of(jax.tree.map(lambda leaf, at=at, k=k: leaf[at, k], offers.offer.scenes))
                for k in range(2 * toggle.count + 1)
            ]
            weights = target[options] * np.exp(-offers.offer.log_offered[at])
            total = weights.sum()
            moved = 0.0
            for k in range(1, len(options)):
                if weights[k] > 0:
                    chance = weights[k] / (total - weights[0])
                    chance *= min(1.0, (total - weights[0]) / (total - weights[k]))
                    matrix[row, options[k]] += probability * chance
                    moved += chance
            matrix[row, row] += probability * (1 - moved)
    return matrix


def toy_error(count: int) -> float:
    """Largest |pi_i P_ij - pi_j P_ji|, the target and the births being any."""
    rng = np.random.default_rng(0)
    target = rng.dirichlet(np.ones(7))
    births = ListedPlaces(jnp.log(jnp.asarray(rng.dirichlet(np.ones(PLACES), 2))))
    toggle = PairToggle(births, count, grafts=False)
    matrix = toy_matrix(target, toggle)
    np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=1e-12)
    flow = target[:, None] * matrix
    return float(np.abs(flow - flow.T).max())


def test_the_toy_chain_is_reversible() -> None:
    """Seven states, two poses each: the flow between any two states is the same both ways to 1e-12."""
    assert toy_error(2) < 1e-12


def test_a_toy_chain_that_forgets_the_number_of_poses_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mutant without 1 / K."""
    from scene.mcmc import pair_toggle

    class WithoutLog:
        def __getattr__(self, name: str) -> object:
            return (lambda _: 0.0) if name == "log" else getattr(jnp, name)

    monkeypatch.setattr(pair_toggle, "jnp", WithoutLog())
    assert toy_error(2) > 1e-3


WIDTH, STRIP_PLACES, BACKGROUND_M, SIGMA_M = 24, 20, 1.0, 0.15
STEPS_M = np.array([[0.6, 0.6, 0.75, 0.75, np.inf], [0.55, 0.85, 0.85, 0.55, 0.55]])
"""Two step-shaped objects, depth over pixels from their place on."""


def strip_depth(kinds: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Depth (S, WIDTH) of scenes of these kinds (n,) at places (S, n); a place of -1 is none."""
    depth = np.full((len(places), WIDTH + 5), BACKGROUND_M)
    for kind, at in zip(kinds, places.T, strict=True):
        for pixel, step_m in enumerate(STEPS_M[kind]):
            where = np.maximum(at, 0) + pixel
            mine = np.where(at < 0, np.inf, step_m)
            depth[np.arange(len(at)), where] = np.minimum(depth[np.arange(len(at)), where], mine)
    return depth[:, :WIDTH]


def strip_log_density(observed_m: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """Log density (S,) of a strip: normal, or something unknown that goes on from the pixel before."""
    before = np.concatenate([[BACKGROUND_M], observed_m[:-1]])
    unknown = 0.5 * np.exp(-0.5 * ((observed_m - before) / 0.1) ** 2) / (0.1 * np.sqrt(2 * np.pi)) + 0.25
    scene = np.exp(-0.5 * ((observed_m - depth_m) / SIGMA_M) ** 2) / (SIGMA_M * np.sqrt(2 * np.pi))
    return np.log(0.8 * scene + 0.2 * unknown).sum(axis=1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StripLikelihood(SeparateLikelihoods):
    """The same of scenes whose objects are at the whole part of x."""

    depends_on_graph: ClassVar[bool] = False
    observed_m: jax.Array
    kinds: jax.Array

    def start(self, key: jax.Array, scene: SceneGraph) -> Estimate:  # noqa: ARG002
        """At once up to date."""
        return Estimate(self._log_density(scene), ())

    def offered(
        self,
        keys: jax.Array,  # noqa: ARG002
        scenes: SceneGraph,
        moved: jax.Array,  # noqa: ARG002
        current: Estimate,  # noqa: ARG002
        *,
        anew: jax.Array,  # noqa: ARG002
    ) -> Estimate:
        """All computed."""
        return Estimate(jax.vmap(self._log_density)(scenes), ())

    def _log_density(self, scene: SceneGraph) -> jax.Array:
        at = jnp.clip(jnp.floor(scene.poses[:, 4]).astype(int), 0, STRIP_PLACES - 1)
        pixel = jnp.arange(WIDTH)[None] - at[:, None]
        steps = jnp.asarray(STEPS_M)[self.kinds[:, None], jnp.clip(pixel, 0, STEPS_M.shape[1] - 1)]
        shown = scene.present[:, None] & (pixel >= 0) & (pixel < STEPS_M.shape[1])
        depth = jnp.minimum(jnp.min(jnp.where(shown, steps, jnp.inf), axis=0), BACKGROUND_M)
        before = jnp.concatenate([jnp.full(1, BACKGROUND_M), self.observed_m[:-1]])
        unknown = 0.5 * jax.scipy.stats.norm.pdf(self.observed_m, before, 0.1) + 0.25
        return jnp.sum(
            jnp.log(0.8 * jax.scipy.stats.norm.pdf(self.observed_m, depth, SIGMA_M) + 0.2 * unknown)
        )


def strip_model(observed_m: np.ndarray, kinds: np.ndarray, number: NumberPrior) -> SceneModel:
    """Floating objects with x in [0, STRIP_PLACES)."""
    model = cube_model(len(kinds), structure=CountedTrees.of(number, len(kinds), FloatingTrees()))
    high_m = jnp.array([float(STRIP_PLACES), 1.0, 1.0])
    likelihood = StripLikelihood(jnp.asarray(observed_m), jnp.asarray(kinds))
    return replace(
        model, prior=replace(model.prior, low_m=jnp.zeros(3), high_m=high_m), likelihood=likelihood
    )


def strip_presence(observed_m: np.ndarray, kinds: np.ndarray, number: NumberPrior) -> np.ndarray:
    """Presence (n,) by the sum over all scenes."""
    axes = [np.arange(-1, STRIP_PLACES)] * len(kinds)
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(kinds))
    there = places >= 0
    log_prior = number.log_set_probabilities(len(kinds))[there.sum(axis=1)]
    log_prior -= there.sum(axis=1) * np.log(STRIP_PLACES)
    log_weights = log_prior + strip_log_density(observed_m, strip_depth(kinds, places))
    weights = np.exp(log_weights - log_weights.max())
    return (weights[:, None] * there).sum(axis=0) / weights.sum()


def strip(seed: int) -> np.ndarray:
    """What is seen of the first object at place 6, in twice the noise that is reckoned with."""
    rng = np.random.default_rng(seed)
    depth = strip_depth(np.array([0]), np.array([[6]]))[0]
    return depth + 2 * SIGMA_M * rng.standard_normal(WIDTH)


def empty_chains(key: jax.Array, model: SceneModel, chains: int, present: np.ndarray) -> ChainState:
    """Chains of floating objects at one place, those there that `present` (C,) tells."""
    poses = jnp.tile(jnp.asarray(ABSENT_POSE), (len(present), 1))
    scene = floating_scene(poses, jnp.asarray(present))
    return jax.vmap(lambda key: start_chain(key, model, scene))(jax.random.split(key, chains))


@pytest.mark.parametrize(
    ("kinds", "walks"),
    [
        pytest.param([0, 1], False, marks=pytest.mark.slow),
        ([0, 1], True),
    ],
)
def test_presence_in_a_world_of_strips(key: jax.Array, seed: int, kinds: list[int], walks: bool) -> None:
    """Against the sum over 441 scenes; with other moves and without."""
    number, observed_m, which = BinomialNumber(0.5), strip(seed), np.array(kinds)
    model = strip_model(observed_m, which, number)
    start_key, run_key = jax.random.split(key)
    states = empty_chains(start_key, model, 64, np.zeros(len(kinds), bool))
    walk = WalkMove(jnp.full(len(kinds), 3.0), jnp.ones(len(kinds)), jnp.asarray(30.0))
    toggle = PairToggle(LeafPrior(grafts=False), 4, grafts=False)
    kernel = PresenceKernel(toggle, (walk,) if walks else ())

    states, expected, present = run_presence(run_key, states, model, kernel, 600)

    exact = strip_presence(observed_m, which, number)
    assert (exact > 0.02).any()
    assert (exact < 0.98).any()
    assert_mean(np.asarray(expected)[60:].mean(axis=0), exact, detectable=0.06)
    assert_mean(np.asarray(present)[60:].mean(axis=0), exact, detectable=0.08)
    told, error = presence_of(np.asarray(expected)[60:])
    assert (error < 0.016).all()
    assert (np.abs(told - exact) < 5 * error).all()


@pytest.mark.parametrize(
    "number",
    [
        pytest.param(FixedNumber(2), marks=pytest.mark.slow),
        pytest.param(BinomialNumber(0.5), marks=pytest.mark.slow),
        pytest.param(PoissonNumber(1.5), marks=pytest.mark.slow),
        UncertainBinomialNumber(0.7),
    ],
)
def test_no_data_returns_the_prior_on_the_number(key: jax.Array, number: NumberPrior) -> None:
    """Graph inferred, births from a cloud too, three slots and a table: p(N), and every slot alike.

    Without the factor ((N + 2) / (N + 3))^N of the trees' number, or the 8 of a contact, counts move by more
    than is allowed here.
    """
    model = cube_model(
        3,
        table=True,
        structure=CountedTrees.of(number, 3, WeightedTrees(jnp.asarray(0.5))),
        upward_concentration=2.0,
    )
    centres = jnp.tile(jnp.array([1.0, 0, 0, 0, 0.2, 0, 0.3]), (4, 1, 1))
    cloud = PoseMixture.build(jnp.zeros((4, 1)), centres, jnp.tile(0.1 * jnp.eye(6), (4, 1, 1, 1)))
    births = MixtureBirths(cloud, LeafPrior(grafts=True), jnp.asarray(0.5))
    kernel = PresenceKernel(PairToggle(births, 2, grafts=True), (EdgeMove(),))
    start_key, run_key = jax.random.split(key)
    states = empty_chains(start_key, model, 160, np.array([True, True, False, True]))

    states, expected, present = run_presence(run_key, states, model, kernel, 240)

    counts = np.asarray(present)[40:, :, :3].sum(axis=2)
    shares = np.stack([(counts == n).mean(axis=0) for n in range(4)], axis=1)
    prior = np.exp(number.log_set_probabilities(3)) * comb(3, np.arange(4))
    likely = prior > 0
    assert_mean(
        shares[:, likely] + 1e-9 * key_noise(key, shares[:, likely].shape), prior[likely], detectable=0.09
    )
    assert (shares[:, ~likely] == 0).all()
    each = (prior * np.arange(4)).sum() / 3
    assert_mean(np.asarray(expected)[40:, :, :3].mean(axis=0), each, detectable=0.09)


def key_noise(key: jax.Array, shape: tuple[int, ...]) -> np.ndarray:
    """Where a share never changes its standard error is nothing: a little of it."""
    return np.asarray(jax.random.normal(jax.random.fold_in(key, 1), shape))
