"""What depth images say against an object that nobody has seen: log L(with it) - log L(without)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from scene.likelihood.one_object import DepthEvidence, depth_evidence, log_likelihood_ratio
from scene.objects.scene_object import SceneObject
from scene.observation.depth_view import pixels_at
from shapes import depth_noise
from shapes.geometry.camera import Camera
from shapes.geometry.poses import transform_points
from shapes.rendering.depth_rendering import render_layers
from shapes.rendering.object_library import ObjectLibrary, join
from shapes.rendering.ray_casting import PosedObjects

PAIRS_TOGETHER = 128
"""Pairs of objects that are rendered at once: each has an image of its own."""

ROUGH_POINTS = 24
"""Surface points of a rough look. An object in plain sight is told by any few of them."""

ROUGH_NATS = 3.0
"""Most that one of them tells: a point near an outline may project into a pixel that the object leaves."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenImage:
    """One depth image and what is known to stand before the camera.

    Attributes:
        camera: of the image.
        camera_from_world: (4, 4).
        observed_m: (H, W), `NO_RETURN` where nothing was measured.
        rest_m: (R, H, W) depth of what is known, in each of R draws of it; 0 where anything may hide.
        weight: effective over actual number of pixels.
    """

    camera: Camera
    camera_from_world: NDArray[np.float64]
    observed_m: NDArray[np.float32]
    rest_m: NDArray[np.float32]
    weight: float = 1.0


class DepthImages:
    """All images together: pixels and images are independent given the scene."""

    def __init__(self, images: Sequence[SeenImage], noise: DepthNoise) -> None:
        """Evidence of images of one scene.

        Args:
            images: at least one, each with as many draws of what is known.
            noise: of the sensor and the surfaces together.
        """
        self.images, self.noise = tuple(images), noise
        self.draws = len(images[0].rest_m)
        self._evidence = [
            depth_evidence(
                noise, _cameras(image.camera, self.draws), jnp.asarray(image.observed_m)[None], image.rest_m
            )
            for image in images
        ]

    def seen(self, points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether world points (n, 3) project into any image."""
        seen = [
            pixels_at(transform_points(one.camera_from_world, points_m), one.camera, one.observed_m.shape)[2]
            for one in self.images
        ]
        return np.any(seen, axis=0)

    def layers(self, one: SceneObject, world_from_box: NDArray[np.float64]) -> NDArray[np.float32]:
        """Depth (n, H, W) of an object alone at poses (n, 4, 4) in the first image; +inf where it is not."""
        first = self.images[0]
        return rendered_m(first.camera, first.camera_from_world, one, world_from_box, first.observed_m.shape)

    def log_ratios(self, one: SceneObject, world_from_box: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log ratio (n,) of each pose (n, 4, 4), against the draws of what is known in turn."""
        draw = np.arange(len(world_from_box)) % self.draws
        total = np.zeros(len(world_from_box))
        for image, evidence in zip(self.images, self._evidence, strict=True):
            posed = _posed(image.camera_from_world, world_from_box, draw)
            total += image.weight * log_likelihood_ratio(_library(one), self.noise, evidence, posed)
        return total

    def rough_log_ratios(self, one: SceneObject, world_from_box: NDArray[np.float64]) -> NDArray[np.float64]:
        """A guess (n,) at `log_ratios` from few surface points: it tells what would be in plain sight."""
        points_m = one.points_m[:ROUGH_POINTS]
        total = np.zeros(len(world_from_box))
        for image in self.images:
            camera_from_box = (image.camera_from_world @ world_from_box).astype(np.float32)
            gains = _gains_of_points(
                self.noise, image.camera, image.observed_m, image.rest_m, points_m, camera_from_box
            )
            total += image.weight * np.asarray(gains, np.float64)
        return total

    def log_ratios_behind(
        self,
        one: SceneObject,
        world_from_box: NDArray[np.float64],
        other: SceneObject,
        world_from_other: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """The same where another object, at its pose (n, 4, 4) of the same number, is there for certain."""
        count, pairs, total = len(world_from_box), np.arange(PAIRS_TOGETHER), np.zeros(len(world_from_box))
        for first in range(0, count, PAIRS_TOGETHER):
            filled = np.minimum(first + pairs, count - 1)
            for image in self.images:
                camera, pose = image.camera, image.camera_from_world
                layers_m = rendered_m(camera, pose, other, world_from_other[filled], image.observed_m.shape)
                rest_m = np.minimum(layers_m, image.rest_m[filled % self.draws])
                cameras, observed_m = _cameras(camera, PAIRS_TOGETHER), jnp.asarray(image.observed_m)[None]
                evidence: DepthEvidence = depth_evidence(self.noise, cameras, observed_m, rest_m)
                posed = _posed(pose, world_from_box[filled], pairs)
                ratios = image.weight * log_likelihood_ratio(_library(one), self.noise, evidence, posed)
                total[first : first + PAIRS_TOGETHER] += ratios[: count - first]
        return total


def rendered_m(
    camera: Camera,
    camera_from_world: NDArray[np.float64],
    one: SceneObject,
    world_from_box: NDArray[np.float64],
    shape: tuple[int, ...],
) -> NDArray[np.float32]:
    """Depth (n, H, W) of an object alone at poses (n, 4, 4); +inf where it is not. `shape` is (H, W)."""
    posed = _posed(camera_from_world, world_from_box, np.zeros(len(world_from_box), int))
    return np.asarray(render_layers(_library(one), posed, _cameras(camera, 1), *shape))


@jax.jit
def _gains_of_points(
    noise: DepthNoise,
    camera: Camera,
    observed_m: jax.Array,
    rest_m: jax.Array,
    points_m: jax.Array,
    camera_from_box: jax.Array,
) -> jax.Array:
    """Nats (n,) that surface points (P, 3) gain in the pixels that they project into before the rest.

    Args:
        noise: of the sensor.
        camera: of the image.
        observed_m: (H, W).
        rest_m: (R, H, W), the farthest and the mean density of which are compared.
        points_m: in the object's box frame.
        camera_from_box: (n, 4, 4).
    """
    height, width = observed_m.shape
    density_of_rest = depth_noise.log_density(noise, observed_m[None], rest_m).mean(axis=0)
    points = jnp.einsum("nij,pj->npi", camera_from_box[:, :3, :3], points_m) + camera_from_box[:, None, :3, 3]
    x, y, z = jnp.moveaxis(points, -1, 0)
    column = jnp.round(x / z * camera.fx + camera.cx).astype(jnp.int32)
    row = jnp.round(y / z * camera.fy + camera.cy).astype(jnp.int32)
    inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixel = jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)
    gain = depth_noise.log_density_of_hit(noise, observed_m[pixel], z) - density_of_rest[pixel]
    covers = inside & (z < rest_m.max(axis=0)[pixel])
    return jnp.where(covers, jnp.clip(gain, -ROUGH_NATS, ROUGH_NATS), 0.0).sum(axis=1)


def _library(one: SceneObject) -> ObjectLibrary:
    """The object's, padded like all: one kernel serves all shapes."""
    return join([one.library])


def _cameras(camera: Camera, count: int) -> Camera:
    """The camera so often, leaves (count,)."""
    return jax.tree.map(lambda leaf: np.full(count, leaf, np.float32), camera)


def _posed(
    camera_from_world: NDArray[np.float64],
    world_from_box: NDArray[np.float64],
    index: NDArray[np.integer],
) -> PosedObjects:
    camera_from_box = camera_from_world @ world_from_box
    library_index = np.zeros(len(world_from_box), np.int32)
    leaves = library_index, camera_from_box.astype(np.float32), index.astype(np.int32)
    return PosedObjects(*map(jax.device_put, leaves))
