"""Points are drawn as balls that close surfaces, and noise does not hide them."""

from dataclasses import replace

import numpy as np

from pipeline.publishing.values import RunValues
from pipeline.room import RoomView
from pipeline.views.camera_view import RADIUS_AT_OBJECTS_M, _radii_m, point_radii_m
from shapes.prior import ShapePrior


def test_balls_close_surfaces_near_and_far_and_noise_is_small() -> None:
    """Pixels of a hundredth of a radian see walls at 1 and 3 m; five of them tell 0.3 m."""
    pixels = np.stack(np.meshgrid(np.arange(-30, 30), np.arange(-20, 20)), axis=-1).reshape(-1, 2) / 100
    rays = np.insert(pixels, 2, 1.0, axis=1)
    depth_m = np.where(pixels[:, 0] < 0, 1.0, 3.0)
    noisy = np.array([65, 490, 1030, 1575, 2210])
    depth_m[noisy] = 0.3
    radii_m = point_radii_m((rays * depth_m[:, None]).astype(np.float32), np.zeros((1, 3)))

    wall = np.setdiff1d(np.arange(len(rays)), noisy)
    np.testing.assert_array_less(0.5 * 0.01 * depth_m[wall], radii_m[wall] + 1e-6)
    assert radii_m[noisy].max() < 0.01


def room_of(points_m: np.ndarray) -> RoomView:
    """A cloud that one view of nothing saw."""
    return RoomView(
        points_m=points_m.astype(np.float32),
        normals=np.zeros(points_m.shape, np.int8),
        rgb=None,
        frames=np.zeros(1, np.int32),
        times_ns=np.zeros(1, np.int64),
        depth_mm=np.zeros((1, 4, 4), np.uint16),
        view_rgb=None,
        intrinsics=np.array([4.0, 4.0, 1.5, 1.5]),
        frame_id=np.array("camera"),
        frame_has_parent=np.array(False),
    )


def test_balls_are_small_on_what_was_found_or_learned(parsed_run: RunValues, small_shape: ShapePrior) -> None:
    """Also in the middle of a large face, and inside of a shape's box; beside them they close surfaces."""
    found = replace(parsed_run, slam=None)
    rng = np.random.default_rng(0)
    face = np.concatenate([rng.uniform(-0.04, 0.04, (300, 2)), np.full((300, 1), 0.55)], axis=1)
    radii_m = _radii_m(found, room_of(np.concatenate([face, face + np.array([0.5, 0, 0])])))
    assert (radii_m[:300] == np.float32(RADIUS_AT_OBJECTS_M)).all()
    assert np.median(radii_m[300:]) > RADIUS_AT_OBJECTS_M

    learned = RunValues(slam=None, room=None, shapes={"mug": small_shape})
    low, high = small_shape.bounding_box_m
    inside = rng.uniform(low, high, (300, 3)) @ small_shape.reference_from_grid[:3, :3].T
    inside += small_shape.reference_from_grid[:3, 3]
    radii_m = _radii_m(learned, room_of(np.concatenate([inside, face])))
    assert (radii_m[:300] == np.float32(RADIUS_AT_OBJECTS_M)).all()
    assert np.median(radii_m[300:]) > RADIUS_AT_OBJECTS_M
