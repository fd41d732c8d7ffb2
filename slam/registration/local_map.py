"""The few keyframes that a camera is compared with, and what they show it."""

from __future__ import annotations

from dataclasses import dataclass

import jax

from shapes.geometry.poses import relative_pose
from slam.keyframes.depth_view import CanvasView
from slam.keyframes.rendering import fused_planes, render
from slam.keyframes.surfels import SurfelImage
from slam.registration.alignment import ModelImage


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LocalMap:
    """The keyframes that a camera is compared with.

    Attributes:
        surfaces: stacked (M, ...).
        present: (M,) bool, False for padding.
        poses: (M, 7) reference_from_keyframe.
    """

    surfaces: SurfelImage
    present: jax.Array
    poses: jax.Array

    def keyframes_from_camera(self, reference_from_camera: jax.Array) -> jax.Array:
        """(M, 7) for a camera at (7,)."""
        return jax.vmap(relative_pose, (0, None))(self.poses, reference_from_camera)


def model_image(local_map: LocalMap, camera_pose: jax.Array, view: CanvasView) -> ModelImage:
    """The map fused in the camera at `camera_pose` (7,)."""
    keyframes_from_camera = local_map.keyframes_from_camera(camera_pose)
    image = render(local_map.surfaces, local_map.present, keyframes_from_camera, view.rays, view.camera)
    planes, variance = jax.lax.optimization_barrier(fused_planes(image, keyframes_from_camera))
    return ModelImage(planes, variance, view.camera)
