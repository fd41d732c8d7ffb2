"""Large planes as one each, against the room that the depth was made of."""

import numpy as np

from recordings.types import DepthNoise, Frame
from slam.keyframes.depth_view import FINE_CANVAS, view_of_frame
from slam.keyframes.plane_segmentation import with_plane_segments
from slam.keyframes.planes import region_planes
from tests.slam import box_room

NOISE = DepthNoise()


def test_walls_are_one_plane_each() -> None:
    """Two walls and the ceiling of a corner, noise of a centimetre: within 0.1 degrees and 3 mm."""
    pose = box_room.pose(0.0, -0.6, -0.2, yaw=-0.6, pitch=0.3)
    rng = np.random.default_rng(4)
    depth = box_room.noisy(box_room.depth_image(pose), rng)
    view = view_of_frame(Frame(time_ns=0, depth_m=depth), box_room.INTRINSICS, FINE_CANVAS)
    planes, sizes = (np.asarray(leaf) for leaf in region_planes(view, NOISE))

    whole = with_plane_segments(planes, sizes, view, NOISE)

    assert ((whole != 0).any(axis=0) == (planes != 0).any(axis=0)).all()
    found, count = np.unique(whole.reshape(3, -1), axis=1, return_counts=True)
    large = found[:, (count > 0.03 * whole[0].size) & (found != 0).any(axis=0)]
    assert large.shape[1] >= 2
    for plane in large.T:
        normal = pose[:3, :3] @ plane / np.linalg.norm(plane)
        axis = int(np.argmax(np.abs(normal)))
        assert np.degrees(np.arccos(min(1.0, abs(normal[axis])))) < 0.1
        distance = 1.0 / np.linalg.norm(plane)
        corners = (*box_room.ROOM, *(corner for box in box_room.BOXES for corner in box))
        sides = [abs(corner[axis] - pose[axis, 3]) for corner in corners]
        assert min(abs(distance - side) for side in sides) < 0.003


def test_small_and_curved_surfaces_keep_their_own() -> None:
    """A sphere's pixels are of no plane that reaches over 3% of the image."""
    intrinsics = box_room.INTRINSICS
    v, u = np.mgrid[0 : intrinsics.height, 0 : intrinsics.width]
    x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
    square = 1.0 + x**2 + y**2
    inside = 1.5**2 - square * (1.5**2 - 0.4**2)
    depth = np.where(inside > 0, (1.5 - np.sqrt(np.maximum(inside, 0.0))) / square, 0.0).astype(np.float32)
    view = view_of_frame(Frame(time_ns=0, depth_m=depth), intrinsics, FINE_CANVAS)
    planes, sizes = (np.asarray(leaf) for leaf in region_planes(view, NOISE))

    np.testing.assert_array_equal(with_plane_segments(planes, sizes, view, NOISE), planes)
