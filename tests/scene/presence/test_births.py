"""Where candidates are drawn when the search found nothing."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from scene.presence import births


class Frames:
    """Of six pixels; whoever asks what nothing shows gets none."""

    pixels = 6

    def shown(self, *given: Any) -> None:
        """There is nothing to render."""
        raise AssertionError(given)


def test_nothing_stands_beside_where_nothing_was_found() -> None:
    """A renderer of no objects would divide by their number."""
    given = cast("Any", Frames()), cast("Any", None), [np.zeros((1, 7))] * 2, np.zeros(2, bool)
    front_m, gain = births._others(np.random.default_rng(0), *given)
    assert front_m.shape == gain.shape == (2, 6)
    assert np.isposinf(front_m).all()
    assert not gain.any()


def test_places_are_told_apart_by_their_tops() -> None:
    """Of a cube that was not found the last place is the best one, but 8 mm beside its top the worst."""
    poses = np.tile([1.0, 0, 0, 0, 0, 0, 1], (births.SITES + 2, 1))
    poses[:, 4] = 0.1 * np.arange(len(poses))
    centres = np.concatenate([poses, np.full((len(poses), 3), np.log(0.05))], axis=1)
    owners, top = np.ones(len(centres), int), centres[-1, :7] + [0, 0, 0, 0, 0.008, 0, 0]
    centres, owners = np.concatenate([centres, centres]), np.concatenate([0 * owners, owners])

    def log_density(states: np.ndarray) -> np.ndarray:
        off = np.square((states[..., :7] - top) / 0.001).sum(axis=-1)
        return np.where(np.abs(states[..., 4] - top[4]) > 0.05, -20.0, -0.5 * off)

    kept, climbed = births._best_of_each(log_density, owners, centres, np.array([2, 0]))

    assert kept.tolist() == [0] * (births.SITES + 2) + [1] * births.SITES
    best = climbed[births.SITES + 2]
    assert abs(best[4] - top[4]) < 0.005


def _beside(offsets_m: list[float]) -> np.ndarray:
    """Poses (S, 7) so far along x."""
    poses = np.tile([1.0, 0, 0, 0, 0, 0, 1], (len(offsets_m), 1))
    poses[:, 4] = offsets_m
    return poses


def test_sites_are_away_from_where_an_object_was_found() -> None:
    """Of a brick of 4 x 8 x 20 cm, found at 0 and 0.3 m: 4 cm from both, the rival, then the best alone."""
    known = cast("Any", SimpleNamespace(half_extents_m=np.array([0.02, 0.1, 0.04])))
    pools = _beside([0.0, 0.03, 0.1, 0.15, 0.32])[None]
    start = SimpleNamespace(pools=pools, rivals=_beside([0.2]), log_alone=np.array([[9.0, 8, 2, 5, 7, 0]]))

    sites = births.sites_of(cast("Any", start), 0, 8, known, _beside([0.0, 0.3]))
    every = births.sites_of(cast("Any", start), 0, 8, known, np.zeros((0, 7)))

    assert sites[:, 4].tolist() == [0.2, 0.15, 0.1]
    assert every[:, 4].tolist() == [0.2, 0.0, 0.03, 0.32, 0.15, 0.1]
