"""Of proposed solids the density chooses, and noise is none."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from recordings.types import DepthNoise
from scene.likelihood.pixel_density import PixelDensity
from scene.observation.segmentation import scene_data
from scene.presence.depth_candidates import PresenceFrames
from scene.presence.solid_births import _densest_together, competing_solids, solids_near
from scene.presence.solid_proposals import proposed_solids
from tests.scene.presence.test_solid_proposals import (
    CAMERA_FROM_TABLE,
    INTRINSICS,
    mixture_at,
    rendered,
    seen,
    solids_of,
)

ROOM_M3 = 0.1
"""Of the prior of places."""


class Anywhere:
    """A prior of poses that is even."""

    def log_alone(self, _: NDArray[np.float64], half_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density, Lebesgue times rotations of mass pi^2."""
        return np.full(half_m.shape[:-1], -np.log(ROOM_M3 * np.pi**2))


class Layers:
    """Three solids over five pixels, each as the others would be seen alone."""

    depth_m = np.array([[1, 1, 1, np.inf, np.inf], [2, 2, 2, 2, np.inf], [np.inf, np.inf, np.inf, 1, 1]])
    gain = np.array([[30.0, 30, 30, 0, 0], [20, 20, 20, 20, 0], [0, 0, 0, -90, 40]])

    def shown_solids(self, *_: Any) -> tuple[Any, Any]:
        """Depth and log gain (3, 5)."""
        return self.depth_m, self.gain


def test_solids_are_chosen_for_what_they_add() -> None:
    """The second adds one pixel of its four behind the first, and the third makes the scene less dense."""
    states = solids_of(np.zeros((3, 3)), np.zeros((3, 3)), np.full((3, 3), 0.1))
    given = cast("Any", Layers()), cast("Any", Anywhere()), states, np.zeros(3, bool)
    assert _densest_together(*given, 3) == [0, 1]
    assert _densest_together(*given, 1) == [0]


def frames_of(depth_m: NDArray[np.float32]) -> tuple[PresenceFrames, Any]:
    """An image as presence sees it, and its supports and foreground."""
    data = scene_data(depth_m, INTRINSICS, 1)
    density = PixelDensity.of(data.window.depth_m, data.support_m, DepthNoise(), 0.002, data.window.stride)
    compared = SimpleNamespace(
        views=[data],
        densities=[density],
        camera_from_world=CAMERA_FROM_TABLE[None],
        world_from=lambda _: np.linalg.inv(CAMERA_FROM_TABLE),
    )
    return PresenceFrames(
        compared=cast("Any", compared), renderer=cast("Any", None), log_half=np.zeros((0, 3))
    ), data


def test_noise_is_no_solid(seed: int) -> None:
    """Of an empty table nothing that is proposed makes the image more probable."""
    assert not len(solids_seen(np.random.default_rng(seed), np.full((1, 240, 320), np.inf)))


def test_a_box_is_one_of_few_solids(seed: int) -> None:
    """Within 1 cm in its middle and its sizes."""
    box = solids_of(np.zeros((1, 3)), np.array([[0.0, 0.05, 0.05]]), np.array([[0.06, 0.04, 0.05]]))
    solids = solids_seen(np.random.default_rng(seed), rendered(box, np.array([False])))

    assert 1 <= len(solids) <= 3
    off_m = np.linalg.norm(solids[:, 4:7] - box[:, 4:7], axis=1)
    sizes_m = np.sort(np.exp(solids[:, 7:]), axis=1) - np.sort(np.exp(box[:, 7:]))
    assert ((off_m < 0.01) & (np.abs(sizes_m) < 0.01).all(axis=1)).any(), solids


def test_an_object_competes_with_a_box_of_its_size(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where no piece of the image told one: its box is within 5 mm of what stands there."""
    nothing = np.zeros((0, 10)), np.zeros(0, bool)
    monkeypatch.setattr("scene.presence.solid_births.proposed_solids", lambda *_: nothing)
    box = solids_of(np.zeros((1, 3)), np.array([[0.0, 0.05, 0.05]]), np.array([[0.06, 0.04, 0.05]]))
    rng = np.random.default_rng(seed)
    frames, data = frames_of(seen(rng, rendered(box, np.array([False])), 0.0015))
    low = box + np.array([0, 0, 0, 0, 0.004, 0, -0.03, 0, 0, np.log(1.6)])
    mixture = mixture_at(low)
    solids = competing_solids(rng, frames, cast("Any", Anywhere()), {0: data}, mixture).centres

    assert len(solids) == 1
    np.testing.assert_allclose(solids[0, 4:7], box[0, 4:7], atol=0.005)
    np.testing.assert_allclose(np.exp(solids[0, 7:]), np.exp(box[0, 7:]), atol=0.005)


def test_a_board_is_as_thin_as_it_is(seed: int) -> None:
    """Standing on its edge, 6 mm thick, within 3 mm in half of that."""
    board = solids_of(np.zeros((1, 3)), np.array([[0.0, 0.05, 0.06]]), np.array([[0.08, 0.003, 0.06]]))
    solids = solids_seen(np.random.default_rng(seed), rendered(board, np.array([False])))

    off_m = np.linalg.norm(solids[:, 4:7] - board[:, 4:7], axis=1)
    thickness_m = np.exp(solids[:, 7:]).min(axis=1)
    assert ((off_m < 0.01) & (thickness_m < 0.006)).any(), solids


def solids_seen(rng: np.random.Generator, layers_m: np.ndarray) -> np.ndarray:
    """Solids (n, 10) of an image, in 1.5 mm of noise, of layers (L, 240, 320) on a table."""
    frames, data = frames_of(seen(rng, layers_m, 0.0015))
    proposed = proposed_solids(data, np.linalg.inv(CAMERA_FROM_TABLE))
    return solids_near(rng, frames, cast("Any", Anywhere()), *proposed, 12).centres
