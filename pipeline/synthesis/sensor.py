"""The depth sensor that films a synthetic world: the sensor density's own sampler, and what it leaves out."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from pipeline.synthesis.world import View
from recordings.types import NO_RETURN, DepthNoise
from shapes.depth_noise import sample


@dataclass(frozen=True, kw_only=True)
class DepthSensor:
    """A structured-light camera; every parameter may be set.

    Attributes:
        noise: standard deviation over distance, outliers, missing returns (docs/model.md, section 0).
        noise_free: measure exactly, everywhere that a ray hits within the range.
        quantisation_m: depth is a multiple of it; 0 leaves it continuous.
        min_range_m: nothing nearer returns.
        grazing_limit_deg: no return where the ray meets the surface at a larger angle to its normal.
        edge_jump_m: a pixel whose neighbours leave its plane by more stands at an edge.
        edge_none_probability: share of the pixels at edges that do not return.
    """

    noise: DepthNoise = field(default_factory=DepthNoise)
    noise_free: bool = False
    quantisation_m: float = 0.001
    min_range_m: float = 0.2
    grazing_limit_deg: float = 80.0
    edge_jump_m: float = 0.05
    edge_none_probability: float = 0.5

    def __post_init__(self) -> None:
        if self.quantisation_m < 0 or self.min_range_m < 0 or self.edge_jump_m <= 0:
            raise ValueError("quantisation_m and min_range_m must not be negative, edge_jump_m positive")
        if not 0 <= self.edge_none_probability <= 1:
            raise ValueError(f"edge_none_probability must lie in [0, 1], got {self.edge_none_probability}")

    @property
    def in_millimetres(self) -> bool:
        """True if every depth is a whole number of millimetres."""
        step_mm = self.quantisation_m * 1000
        return not self.noise_free and step_mm > 0 and bool(np.isclose(step_mm, round(step_mm)))

    def measure(self, key: jax.Array, view: View) -> NDArray[np.float32]:
        """One depth image (H, W) of an ideal view, in metres, `NO_RETURN` where nothing was measured."""
        if self.noise_free:
            depth = np.where(np.isfinite(view.depth_m), view.depth_m, NO_RETURN)
            return self._within_range(depth).astype(np.float32)
        noise_key, edge_key = jax.random.split(key)
        depth = np.array(sample(noise_key, self.noise, jnp.asarray(view.depth_m)))
        if self.quantisation_m > 0:
            # by division, as files are read: the same bits as a stored depth
            depth = np.round(depth / self.quantisation_m) / np.float32(1 / self.quantisation_m)
        hit = np.isfinite(view.depth_m)
        depth[hit & (view.cos_incidence < np.cos(np.radians(self.grazing_limit_deg)))] = NO_RETURN
        drop = jax.random.bernoulli(edge_key, self.edge_none_probability, depth.shape)
        depth[np.asarray(drop) & self._at_edge(view.depth_m)] = NO_RETURN
        return self._within_range(depth).astype(np.float32)

    def _at_edge(self, depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Inverse depth is linear over a plane, so its second difference sees jumps and no slopes."""
        inverse = 1 / depth_m
        bend = np.zeros_like(inverse)
        bend[1:-1] = np.abs(np.diff(inverse, 2, axis=0))
        bend[:, 1:-1] = np.maximum(bend[:, 1:-1], np.abs(np.diff(inverse, 2, axis=1)))
        nearest = np.minimum(minimum_filter(depth_m, 3), self.noise.max_range_m)
        return bend * nearest**2 > self.edge_jump_m

    def _within_range(self, depth_m: NDArray[np.floating]) -> NDArray[np.floating]:
        inside = (depth_m >= self.min_range_m) & (depth_m <= self.noise.max_range_m)
        return np.where(inside, depth_m, NO_RETURN)
