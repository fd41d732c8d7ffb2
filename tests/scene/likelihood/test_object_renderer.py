"""What objects show in a window, each alone."""

import numpy as np
import trimesh

from recordings.types import CameraIntrinsics
from scene.likelihood.object_renderer import ObjectRenderer
from scene.objects.scene_object import scene_object
from scene.observation.pixel_window import window_of


def test_no_pose_shows_no_layer() -> None:
    """As where nothing was found whose colours might be compared."""
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    renderer = ObjectRenderer.of([scene_object("box", box.vertices, box.faces)])
    intrinsics = CameraIntrinsics(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5)
    window = window_of(np.ones((24, 32), np.float32), intrinsics)

    layers_m = renderer.layers(np.zeros(0, np.intp), np.zeros((0, 7)), window)

    assert layers_m.shape == (0, *window.depth_m.shape)
