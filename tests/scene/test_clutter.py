"""Unknown surfaces as rivals of asked-for objects."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from recordings.types import CameraIntrinsics, DepthNoise
from scene.clutter import log_density_of_clutter, log_gain_over_clutter
from scene.foreground import scene_data
from scene.scene_data import SceneData
from scene.window import window_over
from shapes import depth_noise

INTRINSICS = CameraIntrinsics(width=96, height=72, fx=90.0, fy=90.0, cx=47.5, cy=35.5)
NOISE = DepthNoise(sigma_base_m=0.003)
BOX = np.s_[20:50, 30:60]
BEFORE_M = 0.1


def _data(depth_m: np.ndarray) -> SceneData:
    """A frame all of which may show things."""
    data = scene_data(depth_m.astype(np.float32), INTRINSICS, 0)
    everything = np.ones(depth_m.shape, bool)
    window = window_over(everything, depth_m.astype(np.float32), INTRINSICS)
    return SceneData(
        view=data.view,
        foreground=data.foreground,
        window=window,
        window_foreground=np.ones(window.depth_m.shape, bool),
        rest_m=np.full(window.depth_m.shape, np.inf, np.float32),
        table=None,
    )


def _gain(depth_m: np.ndarray) -> float:
    """Of an object that shows a face at the box, 1 m away, where the rest of the scene shows nothing."""
    data = _data(depth_m)
    face = np.full(depth_m.shape, np.inf)
    face[BOX] = 1.0
    face_m, observed_m = jnp.asarray(data.window.of(face))[None], jnp.asarray(data.window.depth_m)[None]
    log_object = np.asarray(depth_noise.log_density(NOISE, observed_m, face_m))
    log_rest = np.asarray(depth_noise.log_density_of_miss(NOISE, observed_m))
    return float(log_gain_over_clutter(data, NOISE, np.isfinite(face_m), log_object, log_rest)[0])


@pytest.fixture
def wall() -> np.ndarray:
    """A wall at 1 m, with the sensor's noise."""
    return 1.0 + 0.001 * np.random.default_rng(0).standard_normal((72, 96))


def test_a_face_on_a_wall_is_no_object_and_a_box_before_it_is(wall: np.ndarray) -> None:
    """The same pixels fit as well; only the second ends where the object does."""
    box = wall + BEFORE_M
    box[BOX] -= BEFORE_M
    assert _gain(wall) < -10 < 10 < _gain(box)


def test_smooth_surfaces_are_foretold_and_steps_are_not(wall: np.ndarray) -> None:
    """Highest within a face, at the floor where another surface begins, nothing beside the foreground."""
    wall[:, 48:] += BEFORE_M
    data = _data(wall)
    density = log_density_of_clutter(data, NOISE)
    rows, step = slice(20, -20), int(np.searchsorted(data.window.columns, 48))
    assert np.isfinite(density[rows, step]).all()
    assert (density[rows, step - 10 : step - 3].min(axis=1) - density[rows, step] > 2).all()
    hidden = replace(data, window_foreground=np.zeros_like(data.window_foreground))
    assert (log_density_of_clutter(hidden, NOISE) == -np.inf).all()
