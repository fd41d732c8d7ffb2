"""A keyframe's depth after one frame more, against the update of a Gaussian for each element."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from recordings.types import DepthNoise, Frame
from shapes.depth_noise import standard_deviation
from shapes.geometry.poses import single_precision_poses
from slam.keyframes.depth_view import FINE_CANVAS, view_of_frame
from slam.keyframes.fusion import fuse
from slam.keyframes.surfels import surfel_image
from tests.slam import box_room

NOISE = DepthNoise()
NORMAL, DISTANCE_M = np.asarray([0.35, -0.1, 0.93]), 1.2
NORMAL /= np.linalg.norm(NORMAL)
"""Of the wall that the keyframe knows, n . p = d in its frame."""
DISPLACED_M = 0.001
"""By which the frame sees it farther along its normal: within the gate."""
VARIANCE_M2 = 2e-6


def _slopes() -> np.ndarray:
    intrinsics = box_room.INTRINSICS
    v, u = np.mgrid[0 : intrinsics.height, 0 : intrinsics.width]
    x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
    return np.stack([x, y, np.ones(u.shape)], axis=-1)


def test_a_frame_moves_elements_along_the_normal_by_what_it_is_worth() -> None:
    """Seen at a slant from elsewhere: share v / (v + r g^2), g the ratio of depth changes along both rays."""
    turned = np.linalg.inv(box_room.pose(0, 0, 0)) @ box_room.pose(0.2, 0.0, -0.1, -0.2)
    along = _slopes() @ NORMAL
    keyframe_m = (DISTANCE_M / along).astype(np.float32)
    normal = turned[:3, :3].T @ NORMAL
    along_frame = _slopes() @ normal
    frame_m = (DISTANCE_M + DISPLACED_M - NORMAL @ turned[:3, 3]) / along_frame
    surface = surfel_image(
        view_of_frame(Frame(time_ns=0, depth_m=keyframe_m), box_room.INTRINSICS, FINE_CANVAS), NOISE
    )
    surface = replace(surface, variance_m2=jnp.full_like(surface.variance_m2, VARIANCE_M2))
    frame = view_of_frame(
        Frame(time_ns=1, depth_m=frame_m.astype(np.float32)), box_room.INTRINSICS, FINE_CANVAS
    )

    fused = fuse(surface, frame, jnp.asarray(single_precision_poses(turned)), NOISE)

    height, width = keyframe_m.shape
    points = _slopes() * keyframe_m[..., None]
    seen_from = (points - turned[:3, 3]) @ turned[:3, :3]
    ray = seen_from / seen_from[..., 2:]
    gain = (ray @ normal) / along
    observed_m = (DISTANCE_M + DISPLACED_M - NORMAL @ turned[:3, 3]) / (ray @ normal)
    share = VARIANCE_M2 / (VARIANCE_M2 + standard_deviation(NOISE, observed_m) ** 2 * gain**2)
    moved = np.asarray(fused.depth_m)[:height, :width] - keyframe_m
    told = np.asarray(fused.variance_m2)[:height, :width]
    inner = np.abs(moved) > 0
    inner[:8], inner[-8:], inner[:, :8], inner[:, -8:] = False, False, False, False
    assert inner.mean() > 0.3
    assert gain[inner].min() < 0.9
    # Planes are fitted, and the nearest pixel's ray is compared: a tenth for single elements.
    for found, expected in ((moved, share * DISPLACED_M / along), (told, (1.0 - share) * VARIANCE_M2)):
        ratio = (found / expected)[inner]
        np.testing.assert_allclose(ratio, 1.0, rtol=0.15)
        np.testing.assert_allclose(np.median(ratio), 1.0, rtol=0.02)
