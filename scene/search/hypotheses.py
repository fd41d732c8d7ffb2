"""Pools of pose hypotheses, each with its log density in the image and its prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from scene.config import ParseConfig
from scene.likelihood.colour_layers import ColourLayers
from scene.likelihood.object_renderer import ObjectRenderer
from scene.likelihood.unknown_surfaces import UnknownWeights
from scene.model.number_prior import LOG_SPINS
from scene.objects.scene_object import SceneObject
from scene.objects.slots import OUT_OF_SIGHT
from scene.observation.frame_data import SceneData
from scene.search.assignment import PoseLayers, gain_of, nearest_layer
from scene.search.pixel_sample import ComparedPixels
from scene.search.support_prior import Gravity, log_not_buried
from scene.search.support_table import SupportTable
from scene.search.template_matching import best_distinct
from shapes.geometry.poses import matrices_of


@dataclass(frozen=True, kw_only=True, eq=False)
class PosePools:
    """K poses of each of N objects; a scene (N,) takes one of each, or `absent`.

    Attributes:
        data: the frame.
        objects: what is looked for.
        renderer: of the same objects.
        noise: of the sensor.
        config: settings.
        pixels: that are compared.
        poses: (N, K, 7) camera_from_box.
        layers: what they show, and the absent object.
        colours: of the frame and the objects, where they are compared.
    """

    data: SceneData
    objects: Sequence[SceneObject]
    renderer: ObjectRenderer
    noise: DepthNoise
    config: ParseConfig
    pixels: ComparedPixels
    poses: NDArray[np.float32]
    layers: PoseLayers
    colours: ColourLayers | None = None

    @classmethod
    def of(
        cls,
        data: SceneData,
        objects: Sequence[SceneObject],
        renderer: ObjectRenderer,
        noise: DepthNoise,
        config: ParseConfig,
        size: int,
        learned: UnknownWeights | None = None,
    ) -> PosePools:
        """Pools of `size` poses out of sight; pixels foretell each other as `learned`, or as here."""
        pixels = ComparedPixels.of(data, noise, config, learned)
        return cls(
            data=data,
            objects=objects,
            renderer=renderer,
            noise=noise,
            config=config,
            pixels=pixels,
            poses=np.tile(np.asarray(OUT_OF_SIGHT, np.float32), (len(objects), size, 1)),
            layers=pixels.no_layers(len(objects), size),
            colours=ColourLayers.of(data, objects, pixels.density, config.gamma),
        )

    @property
    def absent(self) -> int:
        """The place of an object that is not there."""
        return self.poses.shape[1]

    def with_poses(
        self, found: NDArray[np.float32], first: int, objects: Sequence[int] | None = None
    ) -> PosePools:
        """The pools with poses (M, n, 7) of some objects, all if none are named, from `first` on.

        Where colours are compared each is turned as they like it best, among turns that no depth can tell.
        """
        which = np.arange(len(found)) if objects is None else np.asarray(objects, np.intp)
        numbers = np.repeat(which, found.shape[1])
        depth_m = self.renderer.layers(numbers, found.reshape(-1, 7), self.data.window)
        log_colour, log_shares = None, np.zeros(found.shape[:2])
        if self.colours is not None:
            turned, shares = self.colours.turned(self.objects, numbers, found.reshape(-1, 7), depth_m)
            if anew := self._told_by_depth(numbers, found.reshape(-1, 7), turned):
                depth_m[anew] = self.renderer.layers(numbers[anew], turned[anew], self.data.window)
            log_colour = self.config.colour_weight * self.colours.log_factors(numbers, turned, depth_m)
            found, log_shares = turned.reshape(found.shape), shares.reshape(found.shape[:2])
        table, mine = self.data.table, [self.objects[one] for one in which.tolist()]
        spins = np.where([one.spin_line.any() for one in mine], LOG_SPINS, 0.0)
        log_prior = spins[:, None] + log_not_buried(table, mine, found, self.config.contact_sigma_m)
        log_prior = log_prior + log_shares
        layers = self.pixels.with_layers(self.layers, depth_m, log_prior, which, first, log_colour)
        poses, changed = self.poses.copy(), np.zeros(self.poses.shape[:2], bool)
        places = which[:, None], first + np.arange(found.shape[1])
        poses[places], changed[places] = found, True
        return replace(self, poses=poses, layers=replace(layers, rests=self._rests(poses, changed)))

    def densest(
        self, found: NDArray[np.float32], scene: NDArray[np.integer], objects: Sequence[int]
    ) -> NDArray[np.float32]:
        """The `pool` densest (M, pool, 7) that differ of poses (M, n, 7) of some objects, by depth alone.

        Each is judged beside the others of a scene (N,).
        """
        table, sigma_m, densest = self.data.table, self.config.contact_sigma_m, []
        for one, poses in zip(objects, found, strict=True):
            depth_m = self.renderer.layers(np.full(len(poses), one), poses, self.data.window)
            front = nearest_layer(self.layers, jnp.asarray(scene), np.arange(len(scene)) != one)
            (log_prior,) = log_not_buried(table, [self.objects[one]], poses[None], sigma_m)
            gains = gain_of(front, *map(jnp.asarray, self.pixels.shown(depth_m))) + log_prior
            rotations = matrices_of(poses)[:, :3, :3].astype(np.float32)
            best = best_distinct(rotations, poses[:, 4:], gains, self.config.pool)
            densest.append(poses[np.asarray(best)])
        return np.stack(densest)

    def _told_by_depth(
        self, numbers: NDArray[np.integer], found: NDArray[np.float32], turned: NDArray[np.float32]
    ) -> list[int]:
        """Which poses (n, 7) were turned to others that show another depth."""
        near = np.array([one.colour is not None and not one.colour.exact for one in self.objects])
        return np.flatnonzero(near[numbers] & (np.abs(turned - found).max(axis=1) > 1e-4)).tolist()

    def _rests(self, poses: NDArray[np.float32], changed: NDArray[np.bool_]) -> SupportTable:
        """How poses (N, K, 7) rest, some of which (N, K) have changed."""
        config = self.config
        gravity = Gravity(
            contact_sigma_m=config.contact_sigma_m,
            loose_sigma_m=config.loose_sigma_m,
            slack_share=config.slack_share,
            floating_weight=config.floating_weight,
        )
        table = None if config.graph == "fixed" else self.data.table
        return gravity.rests(self.data.view, table, self.objects, poses, changed, self.layers.rests)

    def placed(self, scene: NDArray[np.integer]) -> NDArray[np.float32]:
        """The chosen poses (N, 7) of a scene (N,), of the absent ones any."""
        return self.poses[np.arange(len(self.poses)), np.minimum(scene, self.absent - 1)]

    def shown(self, scene: NDArray[np.integer]) -> NDArray[np.float32]:
        """Depth (N, H, W) of every object's chosen pose alone in the window, +inf for absent ones."""
        depth_m = self.renderer.layers(np.arange(len(scene)), self.placed(scene), self.data.window)
        return np.where((scene < self.absent)[:, None, None], depth_m, np.float32(np.inf))
