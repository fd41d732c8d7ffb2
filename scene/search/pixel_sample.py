"""What every pose of the pools shows at the pixels on which the search compares scenes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from scene.config import ParseConfig
from scene.likelihood.object_density import layer_densities
from scene.likelihood.pixel_density import PixelDensity
from scene.likelihood.unknown_surfaces import UnknownWeights
from scene.model.number_prior import log_prior_odds
from scene.observation.frame_data import SceneData
from scene.search.assignment import PoseLayers
from scene.search.support_table import SupportTable

PIXELS = 2048
"""Those of the foreground are filled up to a multiple of this, so that few kernels are compiled."""


@dataclass(frozen=True, eq=False)
class ComparedPixels:
    """The pixels of the foreground, where poses compete; they meet the others one by one.

    Attributes:
        density: of all the pixels.
        log_odds: of an object in one pose against its absence, before the image is seen.
        uncontested: (pixels,) bool, where no object is seen: a pose that covers them has to pay.
        places: (X,) those of the foreground among the pixels.
        weight: (X,) 1, and 0 of those that fill up.
    """

    density: PixelDensity
    log_odds: np.float32
    uncontested: NDArray[np.bool_]
    places: NDArray[np.intp]
    weight: NDArray[np.float32]

    @classmethod
    def of(
        cls, data: SceneData, noise: DepthNoise, config: ParseConfig, learned: UnknownWeights | None = None
    ) -> ComparedPixels:
        """Pixels of a frame, which foretell each other as `learned`, or as here."""
        near, window = data.window_foreground.ravel(), data.window
        places = np.flatnonzero(near)
        size = PIXELS * max(-(-len(places) // PIXELS), 1)
        weight = (np.arange(size) < len(places)).astype(np.float32)
        error_m, log_odds = config.search_error_m, np.float32(log_prior_odds(config.presence))
        density = PixelDensity.of(window.depth_m, data.support_m, noise, error_m, window.stride, learned)
        return cls(density, log_odds, ~near, np.resize(places, size), weight)

    def no_layers(self, objects: int, poses: int) -> PoseLayers:
        """Layers of `poses` poses an object of which none shows anything, and of the absent object, last."""
        shape = objects, poses + 1
        log_alone = np.full(shape, self.log_odds, np.float32)
        log_alone[:, -1] = 0.0
        rest_m, log_rest = (np.ravel(one)[self.places] for one in self._rest)
        return PoseLayers(
            depth_m=jax.device_put(np.full((*shape, len(self.places)), np.inf, np.float32)),
            log_density=jax.device_put(np.zeros((*shape, len(self.places)), np.float32)),
            log_alone=jax.device_put(log_alone),
            rests=SupportTable.sure(*shape),
            rest_m=jax.device_put(rest_m),
            rest_log_density=jax.device_put(log_rest * self.weight),
        )

    def with_layers(
        self,
        layers: PoseLayers,
        depth_m: NDArray[np.float32],
        log_prior: NDArray[np.floating],
        objects: NDArray[np.integer],
        first: int,
        log_colour: jax.Array | None = None,
    ) -> PoseLayers:
        """Layers with poses `first`, `first` + 1, ... of some objects replaced by those of the given depth.

        Args:
            layers: of N objects.
            depth_m: (M * n, H, W) of n poses of each of M objects, alone.
            log_prior: (M, n) of these poses, beside the odds of being there.
            objects: (M,) which ones.
            first: place of the first of them.
            log_colour: (M * n, H, W) what colours add where each is seen; None where they are not compared.
        """
        shown = self.shown(depth_m, log_colour)
        layer_m, density, alone = (leaf.reshape(*log_prior.shape, *leaf.shape[1:]) for leaf in shown)
        places = objects[:, None], first + np.arange(log_prior.shape[1])

        def put(leaf: jax.Array, values: NDArray[np.floating]) -> jax.Array:
            changed = np.array(leaf)
            changed[places] = values
            return jax.device_put(changed)

        return replace(
            layers,
            depth_m=put(layers.depth_m, layer_m),
            log_density=put(layers.log_density, density),
            log_alone=put(layers.log_alone, alone + log_prior),
        )

    def shown(
        self, depth_m: NDArray[np.float32], log_colour: jax.Array | None = None
    ) -> tuple[NDArray[np.float32], ...]:
        """Depth and log density (n, X) of poses of that depth (n, H, W), and what they add elsewhere (n,)."""
        log_density, layer_m = (
            image.reshape(len(depth_m), -1) for image in layer_densities(self.density, depth_m)
        )
        if log_colour is not None:
            log_density = log_density + np.asarray(log_colour).reshape(log_density.shape)
        rest_m, log_rest = map(np.ravel, self._rest)
        elsewhere = np.flatnonzero(self.uncontested)
        seen = layer_m[:, elsewhere] < rest_m[elsewhere]
        gains = np.where(seen, log_density[:, elsewhere] - log_rest[elsewhere], 0.0)
        alone = self.log_odds + gains.sum(axis=1)
        return layer_m[:, self.places], log_density[:, self.places] * self.weight, alone

    @property
    def _rest(self) -> tuple[jax.Array, jax.Array]:
        """Depth and log density (H, W) of the background."""
        return self.density.image.rest_m, self.density.log_rest
