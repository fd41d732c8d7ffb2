"""Candidates with drawn shapes: the shape that is in use stays with its pose."""

from dataclasses import dataclass, field
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from scene.presence.forests import ForestPrior
from scene.presence.posterior import chain_presence, drawn_ensemble
from scene.presence.solids import SolidFits
from tests.statistical import assert_mean

FITTING, LOG_GAIN, PRIOR = 2, 8.0, 0.05
"""Of twenty draws of the shape two fit, by so much; a priori the object is there with that probability."""

SHAPES, CHAINS, DRAWINGS = 20, 32, 60


@dataclass
class OnePixel:
    """Frames of one pixel, which tell draws of the shape apart, whatever the pose."""

    is_fitting: np.ndarray = field(default_factory=lambda: np.arange(SHAPES) < FITTING)

    def drawn_shapes(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Numbers of shapes."""
        return rng.integers(SHAPES, size=shape)

    def shown(self, slots: np.ndarray, states: np.ndarray, shapes: np.ndarray) -> tuple[np.ndarray, ...]:
        """Depth and log gain (n, 1)."""
        del slots, states
        return np.ones((len(shapes), 1), np.float32), LOG_GAIN * self.is_fitting[shapes, None]


class AnyPose:
    """Poses that do not matter, with density 1."""

    centres = np.zeros((1, 1, 10))

    def drawn(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """States (1, count, 10)."""
        del rng
        return np.zeros((1, count, 10))

    def only(self, _: np.ndarray) -> "AnyPose":
        """There is one."""
        return self

    def log_density(self, states: np.ndarray) -> np.ndarray:
        """Zeros."""
        return np.zeros(states.shape[:2])


class AnySize:
    """The prior: of the set alone."""

    sizes = SimpleNamespace(log_density=lambda log_half, _: np.zeros(log_half.shape[:2]))

    def of(self, poses: np.ndarray, *_: object) -> ForestPrior:
        """Of one slot."""
        beside = np.zeros((2, 1, poses.shape[1]))
        log_sets = np.log([1 - PRIOR, PRIOR])
        return ForestPrior(np.ones(poses.shape[:2]), lambda *_: beside, np.zeros(2), log_sets, 1)


def test_presence_by_moves_is_exact_with_drawn_shapes(seed: int) -> None:
    """One object of which a tenth of the shapes fit; where shapes in use were drawn anew, it was .08 less."""
    rng = np.random.default_rng(seed)
    ratio = np.mean(np.exp(LOG_GAIN * OnePixel().is_fitting))
    exact = PRIOR * ratio / (1 - PRIOR + PRIOR * ratio)
    births = SimpleNamespace(mixture=AnyPose(), solids=SolidFits.none())
    given: Any = OnePixel(), AnySize(), births, np.array([-np.inf])
    draw = partial(drawn_ensemble, rng, *given)

    told = [chain_presence(rng, draw, None, DRAWINGS, 4)[0][0, 0] for _ in range(CHAINS)]

    assert_mean(np.array(told), exact, detectable=0.04)
