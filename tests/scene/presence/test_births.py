"""Where candidates are drawn when the search found nothing."""

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
