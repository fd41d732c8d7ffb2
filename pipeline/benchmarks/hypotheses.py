"""Random distinct hypotheses of posed objects, and the image that they are scored against."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics, DepthNoise
from scene.likelihood.one_object import DepthEvidence, depth_evidence
from shapes.geometry.camera import Camera, stacked
from shapes.rendering.depth_rendering import render_layers
from shapes.rendering.object_library import ObjectLibrary
from shapes.rendering.ray_casting import PosedObjects

DISTANCE_M = 0.6
BACKGROUND_M = 0.9
CIRCLE = 1 / 3
"""Diameter of the object's circle, that of its bounding sphere, over the image side."""
NOISE = DepthNoise()


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Images of one size and random views that put the object's circle on a third of their side.

    Attributes:
        library: one object or several of the same extent.
        intrinsics: of the square images.
        observed_m: (side, side) float32, noisy, with pixels that returned nothing.
        evidence: the same against a plane behind the object.
    """

    library: ObjectLibrary
    intrinsics: CameraIntrinsics
    observed_m: NDArray[np.float32]
    evidence: DepthEvidence

    def poses(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Poses camera_from_object (count, 4, 4): any rotation, the circle within the image, depth +-5%."""
        radius, centre = float(self.library.radius_m[0]), np.asarray(self.library.centre_m[0], np.float64)
        depth = DISTANCE_M * rng.uniform(0.95, 1.05, count)
        half_image = 0.5 * self.intrinsics.width / self.intrinsics.fx
        sideways = rng.uniform(-1, 1, (count, 2)) * (half_image * depth - 1.1 * radius)[:, None]
        poses = np.tile(np.eye(4), (count, 1, 1))
        poses[:, :3, :3] = random_rotations(rng, count)
        poses[:, :3, 3] = np.column_stack([sideways, depth]) - poses[:, :3, :3] @ centre
        return poses

    def hypotheses(self, rng: np.random.Generator, count: int) -> PosedObjects:
        """As many random views, the library's objects in turn."""
        return posed(self.poses(rng, count), np.arange(count) % len(self.library))


def problem(library: ObjectLibrary, side: int, rng: np.random.Generator) -> Problem:
    """An observation of the library's first object in an image of side x side pixels."""
    focal = CIRCLE * side * DISTANCE_M / (2 * float(library.radius_m[0]))
    centre = (side - 1) / 2
    intrinsics = CameraIntrinsics(width=side, height=side, fx=focal, fy=focal, cx=centre, cy=centre)
    cameras = stacked([Camera.from_intrinsics(intrinsics)])
    pose = np.eye(4)[None].copy()
    pose[0, :3, 3] = [0, 0, DISTANCE_M] - np.asarray(library.centre_m[0], np.float64)
    layer = np.asarray(render_layers(library, posed(pose, np.zeros(1)), cameras, side, side))[0]
    surface = np.minimum(layer, BACKGROUND_M)
    observed = (surface + rng.normal(0, 0.002, surface.shape)).astype(np.float32)
    observed[rng.random(surface.shape) < 0.05] = 0.0
    rest = jnp.full((1, side, side), BACKGROUND_M, jnp.float32)
    evidence = depth_evidence(NOISE, cameras, jnp.asarray(observed)[None], rest)
    return Problem(library=library, intrinsics=intrinsics, observed_m=observed, evidence=evidence)


def posed(camera_from_object: NDArray[np.float64], object_index: NDArray) -> PosedObjects:
    """Hypotheses (N, 4, 4) before the first camera."""
    return PosedObjects(
        jnp.asarray(object_index, jnp.int32),
        jnp.asarray(camera_from_object, jnp.float32),
        jnp.zeros(len(camera_from_object), jnp.int32),
    )


def random_rotations(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Rotations (count, 3, 3), uniform: normalised Gaussian quaternions."""
    quaternion = rng.normal(size=(count, 4))
    w, x, y, z = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
