"""The prior of poses with graphs summed out: against all trees, and what comes back without data."""

import itertools
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.benchmarks.cubes import cube_model
from scene.hidden.hidden_places import HiddenPlaces
from scene.model.number_prior import (
    BinomialNumber,
    NumberPrior,
    UncertainBinomialNumber,
)
from scene.model.prior import WeightedTrees
from scene.model.scene_graph import ROOT, SceneGraph, all_trees
from scene.objects.orientations import cube_rotations
from scene.objects.scene_object import scene_object
from scene.observation.detection import SupportPlane
from scene.presence.depth_candidates import PresenceFrames
from scene.presence.forests import ForestPrior, log_weighted_trees
from scene.presence.pose_priors import PosePriors
from scene.presence.posterior import Births, Presence, presence_posterior
from scene.presence.size_prior import SizePrior
from scene.presence.solids import SolidFits
from scene.presence.state_mixture import StateMixture
from shapes.geometry.rotation_densities import LOG_CONTACT_JACOBIAN

WEIGHT = 0.5
"""Odds of floating."""


def random_poses(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Anywhere within half a metre."""
    wxyz = rng.standard_normal((*shape, 4))
    wxyz /= np.linalg.norm(wxyz, axis=-1, keepdims=True)
    return np.concatenate([wxyz, rng.uniform(-0.5, 0.5, (*shape, 3))], axis=-1)


TABLE_POSE = np.array([1.0, 0, 0, 0, 0, 0, -0.6])


@dataclass(frozen=True)
class Exactly:
    """So many objects are there."""

    number: int

    def log_set_probabilities(self, slots: int) -> NDArray[np.float64]:
        """Of the one set of all slots."""
        assert slots == self.number
        return np.where(np.arange(slots + 1) == slots, 0.0, -np.inf)


def priors_of(free: int, number: NumberPrior) -> PosePriors:
    """Cubes over a table."""
    model = cube_model(free, table=True, upward_concentration=2.0)
    return PosePriors(
        prior=jax.device_get(model.prior),
        sizes=SizePrior(
            log_half=np.log(np.full((free, 3), 0.5)),
            sigma=np.full((free, 3), 0.1),
            ties=np.tile(np.arange(3), (free, 1)),
        ),
        supports=TABLE_POSE[None],
        slab_half_m=np.full((1, 3), 0.5),
        floating_weight=WEIGHT,
        log_sets=number.log_set_probabilities(free),
        grafts=True,
    )


def test_what_reaches_below_the_table_weighs_less() -> None:
    """Alone and beside others as the search has it; the solid, last, may go on there."""
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    cube = scene_object("cube", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    table = SupportPlane(camera_from_table=np.eye(4), half_size_m=np.full(2, 0.4), bend=np.zeros(6))
    poses = np.tile([1.0, 0, 0, 0, 0, 0, 0.05], (3, 1, 1))
    poses[:, 0, 4] = 0.1 * np.arange(3)
    poses[1:, 0, 6] -= 0.04
    given = poses, np.full((3, 1, 3), 0.05), np.zeros((3, 1)), 2

    free = priors_of(2, Exactly(2))
    priors = (
        free.of(*given),
        replace(free, table=table, contact_sigma_m=0.02, objects=[cube, cube]).of(*given),
    )

    factor = np.exp([[0.0], [-2.0], [0.0]])
    np.testing.assert_allclose(priors[1].on_root, priors[0].on_root * factor, rtol=0.1)
    beside = [one.weights_beside(0, 0) for one in priors]
    np.testing.assert_allclose(beside[1][0], beside[0][0] * factor, rtol=0.1)
    np.testing.assert_allclose(beside[1][1], beside[0][1], rtol=1e-12)


def test_what_lies_in_another_weighs_less() -> None:
    """Two cubes 4 cm in each other at 2 cm: e^-2 once; a third beside them, and a solid, change nothing."""
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    cube = scene_object("cube", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    poses = np.tile([1.0, 0, 0, 0, 0, 0, 0.05], (4, 1, 1))
    poses[:, 0, 4] = [0.0, 0.06, 0.3, 0.3]
    given = poses, np.full((4, 1, 3), 0.05), np.zeros((4, 1)), 3

    free = priors_of(3, Exactly(3))
    free, apart = free.of(*given), replace(free, contact_sigma_m=0.02, objects=3 * [cube]).of(*given)

    scenes = [[(0, 0), (1, 0)], [(1, 0), (2, 0), (0, 0)], [(0, 0), (2, 0)], [(2, 0), (3, 0)]]
    for scene, expected in zip(scenes, (-2.0, -2.0, 0.0, 0.0), strict=True):
        *rest, (last, place) = scene
        hidden = 3 - sum(slot < 3 for slot, _ in scene)
        whole = apart.log_density(scene, hidden) - free.log_density(scene, hidden)
        assert whole == pytest.approx(expected, rel=0.1)
        with_last = (apart.log_densities(rest, last, hidden) - free.log_densities(rest, last, hidden))[place]
        assert with_last == pytest.approx(whole, abs=1e-9)


def test_forests_are_summed(seed: int) -> None:
    """Four objects with weights that are any: all graphs without a circle, to 1e-12."""
    rng = np.random.default_rng(seed)
    root, others = rng.random((4, 1)), rng.random((4, 1, 4, 1)) * (1 - np.eye(4)[:, None, :, None])

    def beside(slot: int, place: int) -> np.ndarray:
        return np.stack([others[:, :, slot, place], others[slot, place]])

    prior = ForestPrior(root, beside, np.zeros(5), np.zeros(5), 4)
    taken = [(slot, 0) for slot in range(4)]

    total = 0.0
    for parents in itertools.product(range(-1, 4), repeat=4):
        if all(leads_to_root(parents, one) for one in range(4)):
            edges = [root[one, 0] if to < 0 else others[one, 0, to, 0] for one, to in enumerate(parents)]
            total += np.prod(edges)

    np.testing.assert_allclose(np.exp(prior.log_density(taken, 0)), total, rtol=1e-12)
    np.testing.assert_allclose(np.exp(prior.log_densities(taken[:3], 3, 0)), total, rtol=1e-12)


def leads_to_root(parents: tuple[int, ...], one: int) -> bool:
    """Whether there is no circle."""
    for _ in parents:
        one = parents[one] if one >= 0 else one
    return one < 0


def test_the_prior_is_that_of_the_chains(seed: int) -> None:
    """Two cubes and a table: the chains' own prior, with its 8, over 8 trees and all pairs of faces."""
    model = cube_model(2, table=True, upward_concentration=2.0, structure=WeightedTrees(jnp.asarray(WEIGHT)))
    poses = random_poses(np.random.default_rng(seed), 2)
    placed = jnp.asarray(np.concatenate([poses, TABLE_POSE[None]]))
    rows = []
    for parents in np.asarray(all_trees(2, table=True)):
        on = np.flatnonzero(parents[:2] != ROOT)
        pairs = np.zeros((36 ** len(on), 3), int)
        pairs[:, on] = np.array(list(itertools.product(range(36), repeat=len(on))))
        rows.append(np.stack([np.tile(parents, (len(pairs), 1)), pairs // 6, pairs % 6], axis=1))
    parents, parent_faces, child_faces = np.moveaxis(np.concatenate(rows), 1, 0)

    def log_prior(parents: jax.Array, parent_faces: jax.Array, child_faces: jax.Array) -> jax.Array:
        return model.log_prior(SceneGraph(parents, child_faces, parent_faces, placed, jnp.ones(3, bool)))

    log_priors = np.asarray(jax.jit(jax.vmap(log_prior))(parents, parent_faces, child_faces))
    contacts = (parents[:, :2] != ROOT).sum(axis=1)
    total = np.exp(log_priors + LOG_CONTACT_JACOBIAN * contacts).sum()

    found = (
        priors_of(2, Exactly(2))
        .of(poses[:, None], np.full((2, 1, 3), 0.5), np.array([[0.3], [-0.7]]), 2)
        .log_density([(0, 0), (1, 0)], 0)
    )
    np.testing.assert_allclose(found, np.log(total) + 0.3 - 0.7, atol=1e-9)


class NothingSeen(PresenceFrames):
    """Images that say nothing: every candidate is seen at one pixel, which it leaves as likely as it is."""

    def __init__(self) -> None:
        pass

    @property
    def pixels(self) -> int:
        """One."""
        return 1

    def drawn_shapes(self, rng: np.random.Generator, shape: int | tuple[int, ...]) -> np.ndarray:
        """The only ones."""
        del rng
        return np.zeros(shape, int)

    def shown(
        self, slots: np.ndarray, states: np.ndarray, shapes: np.ndarray | int = 0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Depth 1, no gain."""
        del states, shapes
        return np.ones((len(slots), 1), np.float32), np.zeros((len(slots), 1), np.float32)


@pytest.mark.parametrize(
    "number",
    [
        BinomialNumber(0.5),
        UncertainBinomialNumber(0.7),
    ],
)
def test_no_data_returns_the_prior_on_the_number(number: NumberPrior, seed: int) -> None:
    """Three cubes of uncertain size over a table, graph inferred, from a cloud: presence is the prior's.

    Within five standard errors, each 0.03 at most.
    """
    told = presence_without_data(priors_of(3, number), seed, chains=16)
    numbers = np.exp(number.log_set_probabilities(3)) * [1, 3, 3, 1]
    expected = 1 - np.cumsum(numbers)[:3]  # of three copies the first is there if any is

    error = told.standard_error
    assert (error < 0.03).all()
    assert (np.abs(told.probability - expected) < 5 * np.maximum(error, 1e-9)).all()
    atol = 5 * 3 * error.max()  # three errors told of presence, at most
    np.testing.assert_allclose(told.number, np.tile(numbers, (3, 1)), atol=atol)


def test_no_data_returns_the_prior_of_three_shapes(seed: int) -> None:
    """Of other shapes than each other, whose presence is no matter of their number; likewise."""
    number = UncertainBinomialNumber(0.7)
    told = presence_without_data(priors_of(3, number), seed, np.eye(3, dtype=bool), chains=16)

    error = told.standard_error
    assert (error < 0.03).all()
    assert (np.abs(told.probability - 0.7) < 5 * np.maximum(error, 1e-9)).all()


def presence_without_data(
    priors: PosePriors, seed: int, alike: NDArray[np.bool_] | None = None, chains: int = 8
) -> Presence:
    """Of three slots, in a cloud of all rotations: round one alone draws would go all the way round."""
    rng = np.random.default_rng(seed)
    wxyz = Rotation.from_matrix(cube_rotations()).as_quat(scalar_first=True)
    centres = np.concatenate([wxyz, np.tile([0, 0, 0.2, *np.log([0.5, 0.5, 0.5])], (len(wxyz), 1))], axis=1)
    widths = np.array([0.7, 0.7, 0.8, 0.5, 0.5, 0.5, 0.12, 0.12, 0.12])
    cloud = StateMixture(
        log_weights=np.full((3, len(wxyz)), -np.log(len(wxyz))),
        centres=np.tile(centres, (3, 1, 1)),
        factors=np.tile(np.diag(widths), (3, len(wxyz), 1, 1)),
        points_m=np.zeros((3, 3)),
        ties=priors.sizes.ties,
    )
    seen, nothing = NothingSeen(), HiddenPlaces.none(3)
    alike = np.ones((3, 3), bool) if alike is None else alike
    births = [Births(mixture=cloud, solids=SolidFits.none())]
    return presence_posterior(rng, seen, priors, births, chains, nothing, alike, np.zeros(3, bool))


@pytest.mark.parametrize("mutant", ["trees", "eight"])
def test_mutants_do_not_return_it(mutant: str, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The number-dependence of p(G) left out, and the 8 of a contact."""
    from scene.presence import pose_priors

    if mutant == "trees":
        monkeypatch.setattr(
            pose_priors, "log_weighted_trees", lambda *given: np.zeros_like(log_weighted_trees(*given))
        )
    else:
        monkeypatch.setattr(pose_priors, "LOG_CONTACT_JACOBIAN", 0.0)
    told = presence_without_data(priors_of(3, UncertainBinomialNumber(0.7)), seed, chains=6)
    assert np.abs(told.probability.mean() - 0.7) > 5 * told.standard_error.mean()
