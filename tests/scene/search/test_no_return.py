"""What the sensor's own rates of no return tell the search."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from recordings.types import NO_RETURN, CameraIntrinsics, DepthNoise, Frame
from scene import parsing
from scene.config import ParseConfig
from scene.objects.scene_object import SceneObject, scene_object
from scene.search.pixel_sample import FOREGROUND_PIXELS, ComparedPixels

NOISE = DepthNoise(none_hit_probability=0.11, none_miss_probability=0.83)


@pytest.mark.parametrize(
    ("rest_m", "cost"), [(np.inf, np.log(0.11 / 0.83)), (0.9, 0.0)], ids=["nothing behind", "a wall behind"]
)
def test_a_pose_pays_for_pixels_without_return_where_nothing_is_behind(rest_m: float, cost: float) -> None:
    """Away from its rim by the ratio of the rates, at its rim by half; nothing before a wall."""
    shape = 12, 16
    observed, rest = np.full(shape, NO_RETURN, np.float32), np.full(shape, rest_m, np.float32)
    pixels = ComparedPixels(
        NOISE,
        jnp.float32(0.003),
        jnp.float32(-50.0),
        jnp.asarray(observed.ravel()),
        jnp.asarray(rest.ravel()),
        jnp.ones(rest.size, bool),
        jnp.zeros(FOREGROUND_PIXELS, jnp.int32),
        jnp.zeros(FOREGROUND_PIXELS, jnp.float32),
        shape,
    )
    depth = np.full((1, *shape), np.inf, np.float32)
    depth[0, 3:8, 4:12] = 0.6
    layers = pixels.with_layers(pixels.no_layers(1, 1), depth, np.zeros((1, 1)), 0)
    inner, rim = 3 * 6, 5 * 8 - 3 * 6
    expected = -50.0 + inner * cost + rim * np.log((1 + np.exp(cost)) / 2)
    np.testing.assert_allclose(float(layers.log_alone[0, 0]), expected, rtol=1e-5)


class SearchedError(Exception):
    """The search was called."""


def test_parse_searches_with_the_sensors_own_rates(key: jax.Array, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever else is configured of the density."""
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    box = scene_object("box", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    depth = np.zeros((48, 64), np.float32)
    depth[10:30, 20:40] = 0.7

    def initialise(*arguments: object) -> None:
        (noise,) = [one for one in arguments if isinstance(one, DepthNoise)]
        assert (noise.none_hit_probability, noise.none_miss_probability) == (0.11, 0.83)
        raise SearchedError

    monkeypatch.setattr(parsing, "initialise", initialise)
    camera = CameraIntrinsics(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)
    objects: Sequence[SceneObject] = [box]
    frame = Frame(time_ns=0, depth_m=depth)
    with pytest.raises(SearchedError), jax.enable_x64(False):
        parsing.parse_scene(key, [frame], [0], np.eye(4)[None], camera, NOISE, objects, ParseConfig())
