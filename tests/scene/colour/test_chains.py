"""Chains over scenes: exact against the sum over a lattice's scenes, and the prior without an image."""

import numpy as np
import pytest
from scipy.stats import chisquare, kstest

from pipeline.benchmarks.air_lattice import LatticeWorld, Summed, chain_kinds
from pipeline.synthesis.air import TABLE_COLOUR
from scene.colour.chains import EXCHANGES, State, exchange_weight, log_spins, sample_scenes
from scene.colour.posterior import Scene, colour_image, log_likelihood, log_prior, overlapping
from scene.colour.proposals import FoundThings
from tests.scene.colour.worlds import small_world
from tests.statistical import FALSE_ALARM

WORLD = small_world()


def found_things() -> FoundThings:
    """Round two boxes and a disc; place and yaw of a box hang together."""
    sd = np.array([[0.01, 0.02, 0.2], [0.02, 0.02, 0.4], [0.01, 0.01, (2 * np.pi) ** -0.5]])
    covariance = sd[:, :, None] * np.eye(3) * sd[:, None]
    covariance[0, 0, 2] = covariance[0, 2, 0] = 0.5 * sd[0, 0] * sd[0, 2]
    return FoundThings(
        WORLD,
        np.array([0, 0, 1]),
        np.array([[0.05, 0.02, 0.3], [-0.06, 0.0, 1.0], [0.0, -0.08, 0.0]]),
        covariance,
        np.array([0.4, 0.3, 0.2]),
    )


def test_an_exchange_and_its_reverse_weigh_nothing(seed: int) -> None:
    """For all that go and come, from one to three things; draws go by the density that is told."""
    rng = np.random.default_rng(seed)
    for going, coming in EXCHANGES:
        back, forth = rng.normal(size=going), rng.normal(size=coming)
        for count in range(going, 4):
            there = exchange_weight(count, back, forth)
            assert there == pytest.approx(-exchange_weight(count - going + coming, forth, back), abs=1e-12)
    birth = exchange_weight(2, np.zeros(0), np.array([0.7]))
    assert birth == pytest.approx(-np.log(3) - 0.7)


def test_things_are_drawn_by_their_density(seed: int) -> None:
    """Weights of the prior over the proposal have the mean 1 (6 standard errors), kinds and yaws included."""
    things = found_things()
    kinds, poses = things.draw(np.random.default_rng(seed), 200_000)
    inside = (np.abs(poses[:, :2]) <= WORLD.half_m).all(axis=1)
    prior = 1 / (2 * (2 * WORLD.half_m) ** 2 * 2 * np.pi)
    density = np.exp(np.concatenate([things.log_density(*part) for part in _parts(kinds, poses)]))
    weight = np.where(inside, prior / density, 0.0)
    shares = {1.0: kinds >= 0, 0.5: kinds == 0, 0.5 / np.pi: (kinds == 1) & (poses[:, 2] < 2)}
    for expected, chosen in shares.items():
        share = weight * chosen
        assert abs(share.mean() - expected) < 6 * share.std() / np.sqrt(len(share))


def _parts(kinds: np.ndarray, poses: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(kinds[at : at + 20_000], poses[at : at + 20_000]) for at in range(0, len(kinds), 20_000)]


def test_without_an_image_chains_return_the_prior(seed: int) -> None:
    """Numbers, kinds, places and yaws as of scenes drawn evenly that keep the overlap rule.

    False alarm 1e-6 each, on every 7th sweep.
    """
    rng = np.random.default_rng(seed)

    def target(scene: Scene, _lamp: int) -> float:
        return log_prior(WORLD, scene) + log_spins(WORLD, scene)

    start = State(Scene.empty(), 0, target(Scene.empty(), 0))
    chain = sample_scenes(rng, target, start, found_things(), 2, np.zeros(1), 7_000)
    scenes = [state.scene for number, state in enumerate(chain) if number % 7 == 0]
    side = WORLD.half_m
    drawn = []
    while len(drawn) < 4_000:
        count = int(rng.integers(3))
        poses = rng.uniform([-side, -side, 0], [side, side, 2 * np.pi], (count, 3))
        one = Scene(rng.integers(2, size=count), poses)
        if not overlapping(WORLD, one).any():
            drawn.append(one)
    keys = [(), (0,), (1,), (0, 0), (0, 1), (1, 1)]
    counts = [
        np.array([sum(tuple(sorted(one.kinds.tolist())) == key for one in part) for key in keys])
        for part in (scenes, drawn)
    ]
    pooled = counts[1] / counts[1].sum()
    spread = np.sqrt(pooled * (1 - pooled) * (1 / len(scenes) + 1 / len(drawn)))
    assert (np.abs(counts[0] / len(scenes) - pooled) < 6 * spread).all()
    alone = np.array([one.poses[0] for one in scenes if len(one) == 1])
    assert kstest(alone[:, 0], "uniform", (-side, 2 * side)).pvalue > FALSE_ALARM
    turns = np.histogram(alone[:, 2] % (2 * np.pi), 8, (0, 2 * np.pi))[0]
    assert chisquare(turns).pvalue > FALSE_ALARM


Drawn = tuple[LatticeWorld, np.ndarray, Summed]


def drawn_image(lattice: LatticeWorld, number: int) -> Drawn:
    """An image of the model, and its sum over all scenes."""
    _, _, image = lattice.drawn(np.random.default_rng([number, 11]))
    return lattice, image, Summed.of(lattice, image)


@pytest.fixture(scope="module")
def drawn() -> Drawn:
    """One in doubt, under either of two lamps."""
    return drawn_image(LatticeWorld.of(), 3)


def judged(rng: np.random.Generator, drawn: Drawn, sweeps: int) -> tuple[float, float]:
    """Largest difference of a chain's p(N), and total variation over (N, kinds), from the sum."""
    lattice, _, summed = drawn
    exact = summed.kinds(lattice.lattices[0].kinds)
    sampled = chain_kinds(rng, lattice, summed, sweeps)
    apart = {kinds: exact[kinds] - sampled.get(kinds, 0.0) for kinds in exact}
    numbers = [sum(value for kinds, value in apart.items() if len(kinds) == count) for count in range(3)]
    assert sum(exact.values()) == pytest.approx(1)
    return float(np.abs(numbers).max()), 0.5 * sum(map(abs, apart.values()))


def test_chains_agree_with_the_sum_over_a_lattice(seed: int, drawn: Drawn) -> None:
    """An image in doubt: p(N), kinds within 0.045, four times what so short a chain is off (8 runs)."""
    lattice, _, summed = drawn
    assert max(summed.kinds(lattice.lattices[0].kinds).values()) < 0.95
    assert max(judged(np.random.default_rng(seed), drawn, 40_000)) < 0.045


def test_sums_are_the_posteriors(seed: int, drawn: Drawn) -> None:
    """Of pairs that share pixels: the priors of two are twice the product of those of each."""
    lattice, image, summed = drawn
    world = lattice.worlds[1]
    view = colour_image(world, image, np.array(TABLE_COLOUR))
    pairs = np.random.default_rng(seed).permutation(np.argwhere(lattice.possible & lattice.touching))[:20]
    for one, other in pairs.tolist():
        apart = summed.single[1, one] + summed.single[1, other] - summed.empty[1]
        gains = [
            log_likelihood(world, view, lattice.scene(*some)) for some in ((one, other), (one,), (other,))
        ]
        expected = gains[0] - gains[1] - gains[2] + np.log(2)
        assert summed.pair[1, one, other] - apart == pytest.approx(expected, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(10))
def test_chains_agree_with_the_sum_on_fifty_images(seed: int, part: int) -> None:
    """Two lamps; p(N) and total variation over kinds within 0.01."""
    lattice, rng = LatticeWorld.of(), np.random.default_rng(seed)
    numbers = range(5 * part, 5 * part + 5)
    worst = np.max([judged(rng, drawn_image(lattice, one), 400_000) for one in numbers], axis=0)
    assert (worst < 0.01).all(), worst
