"""The likelihood of whole scenes in chains: depth images in which the nearest surface is seen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import jax
import jax.numpy as jnp
import jaxlie
from jax.custom_batching import custom_vmap

from recordings.types import DepthNoise
from scene.graph import SceneGraph
from scene.model import Estimate
from scene.rendering import OUT_OF_SIGHT, ObjectRenderer
from scene.window import WINDOW_HEIGHT, WINDOW_WIDTH
from shapes import depth_noise
from shapes.camera import Camera
from shapes.depth_rendering import render_layers


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DepthImages:
    """prod over frames and pixels of the sensor's density, to the power `pixel_weight`.

    Neighbouring pixels share their error, of the sensor and of the shape, so that a pixel is worth less
    than an independent measurement: `pixel_weight` is the effective number of pixels over their number.
    What is neither an object nor the table is taken as it was seen. Objects are bodies 0..N-1.

    Attributes:
        renderer: the N objects.
        cameras: leaves (F,), of the windows.
        camera_from_world: (F, 7).
        observed_m: (F, H, W) float32.
        rest_m: (F, H, W) float32, the background's depth.
        inside: (F, H, W) float32, 0 for pixels beyond the image.
        noise: of the sensor.
        surface_sigma_m: error of the objects' surfaces.
        pixel_weight: the exponent.
        objects: N.
    """

    depends_on_graph: ClassVar[bool] = False
    renderer: ObjectRenderer
    cameras: Camera
    camera_from_world: jax.Array
    observed_m: jax.Array
    rest_m: jax.Array
    inside: jax.Array
    noise: DepthNoise
    surface_sigma_m: jax.Array
    pixel_weight: jax.Array
    objects: int = field(metadata={"static": True})

    def start(self, key: jax.Array, scene: SceneGraph) -> Estimate:
        """All layers rendered."""
        shape = (self.objects, len(self.observed_m), WINDOW_HEIGHT, WINDOW_WIDTH)
        nothing = Estimate(jnp.zeros((), scene.poses.dtype), jnp.full(shape, jnp.inf, jnp.float32))
        return self.update(key, scene, scene.present, nothing)

    def update(
        self,
        key: jax.Array,  # noqa: ARG002
        scene: SceneGraph,
        moved: jax.Array,
        current: Estimate,
    ) -> Estimate:
        """The layers of what moved rendered anew, the others kept."""
        moved = moved[: self.objects]
        layers = jnp.where(moved[:, None, None, None], self._render(scene, moved), current.draws)
        return Estimate(self.pixel_weight * self.log_density(layers, scene.present), layers)

    def log_density(self, layers: jax.Array, present: jax.Array) -> jax.Array:
        """Log density of all images, exponent 1, given layers (N, F, H, W) of which some are present."""
        use = present[: self.objects][:, None, None, None]
        shown = jnp.minimum(jnp.min(jnp.where(use, layers, jnp.inf), axis=0), self.rest_m)
        log_pixels = depth_noise.log_density(self.noise, self.observed_m, shown, self.surface_sigma_m)
        return jnp.sum((log_pixels * self.inside).astype(jnp.float64))

    def _render(self, scene: SceneGraph, use: jax.Array) -> jax.Array:
        """Layers (N, F, H, W); what is not used is put out of sight, where it costs nothing."""
        poses = scene.poses[: self.objects]

        def in_camera(camera: jax.Array, pose: jax.Array) -> jax.Array:
            return (jaxlie.SE3(camera) @ jaxlie.SE3(pose)).wxyz_xyz

        seen = jax.vmap(jax.vmap(in_camera, in_axes=(0, None)), in_axes=(None, 0))(
            self.camera_from_world, poses
        )
        aside = jnp.asarray(OUT_OF_SIGHT, seen.dtype)[None, None]
        seen = jnp.where(use[:, None, None], seen, aside).astype(jnp.float32)
        return _render_batch(self.renderer, self.cameras, seen)


@custom_vmap
def _render_batch(renderer: ObjectRenderer, cameras: Camera, poses: jax.Array) -> jax.Array:
    """Layers (..., N, F, H, W) of the N objects at poses (..., N, F, 7) camera_from_box."""
    objects, frames = poses.shape[-3:-1]
    lead = poses.shape[:-3]
    indices = jnp.broadcast_to(jnp.arange(objects)[:, None], (*lead, objects, frames)).ravel()
    images = jnp.broadcast_to(jnp.arange(frames)[None], (*lead, objects, frames)).ravel()
    with jax.enable_x64(False):  # the engine works in float32 and int32
        posed = renderer.posed(indices.astype(jnp.int32), poses.reshape(-1, 7), images.astype(jnp.int32))
        depth = render_layers(renderer.library, posed, cameras, WINDOW_HEIGHT, WINDOW_WIDTH)
    return depth.reshape(*poses.shape[:-1], WINDOW_HEIGHT, WINDOW_WIDTH)


@_render_batch.def_vmap
def _(
    axis_size: int, in_batched: tuple, renderer: ObjectRenderer, cameras: Camera, poses: jax.Array
) -> tuple[jax.Array, bool]:
    """Chains side by side are more objects to the engine, whose loops then stay full."""
    del axis_size
    assert not any(jax.tree.leaves(in_batched[:2]))
    return _render_batch(renderer, cameras, poses), True
