"""Known colours tell things of one shape apart, and the spin of what is round, whatever the light."""

import numpy as np
import pytest

from pipeline.synthesis.air import photograph
from scene.colour.density import sample
from scene.colour.lattice import Lattice
from scene.colour.posterior import Scene
from scene.colour.search import find
from scene.colour.weighing import FoundScene
from tests.scene.colour.worlds import coloured_world

WORLD = coloured_world()
LATTICE = Lattice.of(WORLD)
RED, BLUE, HALVES = range(3)


PIXEL_M = 0.75 / 1.7 / 72
"""Width of a pixel at the table."""
PIXEL_RAD = PIXEL_M / 0.03
"""The same at a disc's rim: pixels on the seam of two colours are mixed."""


def turned_by(yaw: float, other: float) -> float:
    """Angle between two yaws."""
    return abs((yaw - other + np.pi) % (2 * np.pi) - np.pi)


def picture(rng: np.random.Generator, scene: Scene, gain: np.ndarray) -> np.ndarray:
    """By Embree, under a light of such a gain (3,) of each channel."""
    clean, _ = photograph(WORLD, scene, np.tile(gain, (len(scene), 1)))
    return sample(rng, clean, WORLD.noise)


def paired(found: FoundScene, truth: Scene) -> Scene:
    """What was found in the truth's order: its kinds differ."""
    order = [found.best.scene.kinds.tolist().index(kind) for kind in truth.kinds]
    return Scene(found.best.scene.kinds[order], found.best.scene.poses[order])


def test_colours_are_part_of_what_looks_the_same() -> None:
    """Discs of one colour are round; that of two halves is not."""
    assert [kind.turns for kind in WORLD.kinds] == [0, 0, 1]


@pytest.mark.parametrize("gain", [(1.0, 1.0, 1.0), (0.8, 0.9, 1.2)])
def test_colour_tells_lookalikes_and_spins(seed: int, gain: tuple[float, float, float]) -> None:
    """Which of three discs stands where, to half a pixel, and how the one of two halves is turned."""
    truth = Scene(np.array([BLUE, HALVES]), np.array([[-0.06, 0.03, 0.0], [0.07, -0.02, 2.1]]))
    found = find(LATTICE, picture(np.random.default_rng(seed), truth, np.array(gain)))

    assert sorted(found.best.scene.kinds.tolist()) == [BLUE, HALVES]
    poses = paired(found, truth).poses
    assert np.linalg.norm(poses[:, :2] - truth.poses[:, :2], axis=1).max() < PIXEL_M / 2
    assert turned_by(poses[1, 2], 2.1) < PIXEL_RAD


def test_another_gain_of_a_channel_changes_little(seed: int) -> None:
    """Kinds stay, and poses within half a pixel: noise keeps its size while the light changes."""
    truth = Scene(np.array([RED, HALVES]), np.array([[-0.05, -0.04, 0.0], [0.06, 0.05, 0.8]]))
    image = picture(np.random.default_rng(seed), truth, np.ones(3))
    before = paired(find(LATTICE, image), truth)
    after = paired(find(LATTICE, image * [0.85, 1.0, 1.15]), truth)

    assert np.linalg.norm(after.poses[:, :2] - before.poses[:, :2], axis=1).max() < PIXEL_M / 2
    assert turned_by(after.poses[1, 2], before.poses[1, 2]) < PIXEL_RAD
