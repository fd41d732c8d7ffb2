"""What the sensor's own rates of no return tell the search."""

from collections.abc import Sequence

import jax
import numpy as np
import pytest
import trimesh

from recordings.types import NO_RETURN, CameraIntrinsics, DepthNoise, Frame
from scene import joint_search, parsing
from scene.config import ParseConfig
from scene.likelihood.pixel_density import PixelDensity
from scene.likelihood.pixel_factors import UNKNOWN
from scene.objects.scene_object import SceneObject, scene_object
from tests.scene.likelihood.whole_image import of_object

NOISE = DepthNoise(none_hit_probability=0.11, none_miss_probability=0.83)


NOTHING_HERE = (1 - UNKNOWN) * 0.83 + UNKNOWN * 0.11
"""Rate of no return where no surface of the scene is and no pixel before tells of anything unknown."""


shown_by_object = jax.jit(of_object)


@pytest.mark.parametrize(
    ("rest_m", "cost"),
    [(np.inf, np.log(0.11 / NOTHING_HERE)), (0.9, 0.0)],
    ids=["nothing behind", "a wall behind"],
)
def test_a_pose_pays_for_pixels_without_return_where_nothing_is_behind(rest_m: float, cost: float) -> None:
    """Inside its outline by the ratio of the rates; nothing before a wall."""
    observed, rest = np.full((12, 16), NO_RETURN, np.float32), np.full((12, 16), rest_m, np.float32)
    layer = np.full((12, 16), np.inf, np.float32)
    layer[3:8, 4:12] = 0.6
    with jax.enable_x64(False):  # as the program starts it
        density = PixelDensity.of(observed, rest, NOISE, 0.003, 1)
        shown, _ = shown_by_object(density, layer)
        inside = np.asarray(shown - density.log_rest)[4:7, 5:11]
    np.testing.assert_allclose(inside, cost, atol=1e-5)


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

    monkeypatch.setattr(joint_search, "initialise", initialise)
    camera = CameraIntrinsics(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)
    objects: Sequence[SceneObject] = [box]
    frame = Frame(time_ns=0, depth_m=depth)
    with pytest.raises(SearchedError), jax.enable_x64(False):
        parsing.parse_scene(key, [frame], [0], np.eye(4)[None], camera, NOISE, objects, ParseConfig())
