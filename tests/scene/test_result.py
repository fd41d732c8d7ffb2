"""What a parsed scene says of its own uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from tests.scene.results import scene_result

STEP = 1e-6


def test_a_point_far_from_the_origin_moves_more_where_the_object_turns(seed: int) -> None:
    """The covariance of its place against small motions of the object, one by one."""
    generator = np.random.default_rng(seed)
    spread = generator.normal(size=(6, 6))
    point = generator.normal(size=3)
    scene = replace(scene_result(["mug"], [np.eye(4)], [0]), covariance=(spread @ spread.T)[None])

    moved = np.array([_moved(point, STEP * motion) for motion in np.eye(6)])
    jacobian = (moved - point).T / STEP

    np.testing.assert_allclose(
        scene.covariance_of_point(0, point), jacobian @ scene.covariance[0] @ jacobian.T, rtol=1e-4, atol=1e-4
    )


def _moved(point: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """A point (3,) of an object that moves by (v, w) in its own frame."""
    return Rotation.from_rotvec(motion[3:]).apply(point) + motion[:3]
