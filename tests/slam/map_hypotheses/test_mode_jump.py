"""Views far apart: what agrees is left alone, a cluster that is turned against the rest is put right."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recordings.types import DepthNoise
from slam.keyframes.depth_view import view_of_frame
from slam.keyframes.keyframe_map import KeyframeMap
from slam.keyframes.surfels import surfel_image
from slam.likelihood.image_density import log_image_density
from slam.map_hypotheses.cross_registration import KeyframeRegistrar, consistent_set, register_inconsistent
from tests.slam import box_room

NOISE = DepthNoise()
YAWS = (-0.9, -0.45, 0.0, 0.45, 0.9)
TURNED = (3, 4)


def seen_from_all_sides() -> NDArray[np.float64]:
    """Poses (5, 4, 4) in the first one's frame, on an arc round the boxes."""
    world = np.stack(
        [box_room.pose(0.3 - 2.2 * np.sin(yaw) * 0.7, -0.2, 1.3 - 2.2 * np.cos(yaw), yaw) for yaw in YAWS]
    )
    return np.linalg.inv(world[0]) @ world


def registrar(seed: int) -> KeyframeRegistrar:
    """Noisy keyframes at those poses."""
    keyframe_map = KeyframeMap()
    world = box_room.pose(0.3 - 2.2 * np.sin(YAWS[0]) * 0.7, -0.2, 1.3 - 2.2 * np.cos(YAWS[0]), YAWS[0])
    for frame in box_room.frames(world @ seen_from_all_sides(), seed):
        view = view_of_frame(frame, box_room.INTRINSICS)
        keyframe_map = keyframe_map.with_keyframe(surfel_image(view, NOISE))
    return KeyframeRegistrar(keyframe_map, NOISE, compared=4)


def with_a_turned_cluster() -> NDArray[np.float64]:
    """The last two right to each other, and turned by 20 degrees against the others."""
    poses = seen_from_all_sides()
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("y", 20, degrees=True).as_matrix()
    turn[:3, 3] = (0.2, 0.0, 0.1)
    for index in TURNED:
        poses[index] = turn @ poses[index]
    return poses


def test_what_agrees_is_left_alone():
    """At true poses no keyframe contradicts; turned ones do, and are told."""
    of_all = registrar(seed=1)

    assert consistent_set(of_all, seen_from_all_sides()) == [0, 1, 2, 3, 4]
    assert consistent_set(of_all, with_a_turned_cluster()) == [0, 1, 2]
    assert of_all.log_composite(seen_from_all_sides()) > of_all.log_composite(with_a_turned_cluster())


def test_what_two_images_share_counts_once():
    """Seeing each other instead of nothing, two images gain p(2 | 1) / p(2), as by the chain rule, and once.

    p(1 | 2) / p(1) is the same number but for what each image sees alone: 1,099 and 1,224 nats here. A
    composite twice or half as large would be off by half at least.
    """
    of_all = registrar(seed=5).keyframe_map
    of_two = KeyframeRegistrar(of_all.only([0, 1]), NOISE, compared=4)
    together = seen_from_all_sides()[:2]
    apart = together.copy()
    apart[1, :3, 3] += (0.0, 0.0, 50.0)

    gained = of_two.log_composite(together) - of_two.log_composite(apart)

    place = of_two.register_locally(together, 1, [0])
    pixels, seen_from = place.optimum.pixels, place.local_map.keyframes_from_camera(place.optimum.pose)
    unmapped = replace(pixels, weights=jnp.zeros_like(pixels.weights))
    by_chain_rule = float(place.optimum.log_density - log_image_density(unmapped, seen_from, NOISE, 1.0))
    assert by_chain_rule > 300.0
    np.testing.assert_allclose(gained, by_chain_rule, rtol=0.2)


@pytest.mark.slow
def test_a_turned_cluster_is_put_right():
    """A cluster 20 degrees off comes back to within a centimetre and half a degree."""
    placed = register_inconsistent(registrar(seed=2), with_a_turned_cluster(), [0, 1, 2])

    relative = np.linalg.inv(seen_from_all_sides()) @ placed
    assert np.linalg.norm(relative[:, :3, 3], axis=1).max() < 0.01
    assert np.degrees(Rotation.from_matrix(relative[:, :3, :3]).magnitude()).max() < 0.5
