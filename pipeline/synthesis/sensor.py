"""The depth sensor that films a synthetic world: the sensor density's own sampler, and what it leaves out."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from pipeline.synthesis.sensor_errors import clustered, correlated_normals
from pipeline.synthesis.world import View
from recordings.distortion_field import LARGEST_PER_M, NODE_COLUMNS, NODE_ROWS, pixel_weights
from recordings.settings import check_finite
from recordings.types import NO_RETURN, DepthNoise
from shapes.depth_noise import sample

HOLE_PX = 4.0
"""Over which holes on dark and shining surfaces hang together."""


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
        correlation: of residuals 1, 2, ... pixels apart; empty leaves pixels independent.
        quantisation_growth_per_m: growth of the quantisation's step with squared distance, in 1/m, where it
            has one.
        scale_error: standard deviation of the factor by which a camera's depths are too long.
        distortion_per_m: standard deviation, at the nodes, of the field d by which a camera's inverse depths
            err alike in all its images (`recordings.distortion_field`).
        dark_level: a surface darker than this share of white returns badly.
        dark_none_probability: share of such a surface that does not return, in blots.
        shine_deg: a surface met within this angle of its normal may shine.
        shine_none_probability: share of such a surface that does not return, in blots.
    """

    noise: DepthNoise = field(default_factory=DepthNoise)
    noise_free: bool = False
    quantisation_m: float = 0.001
    min_range_m: float = 0.2
    grazing_limit_deg: float = 80.0
    edge_jump_m: float = 0.05
    edge_none_probability: float = 0.5
    correlation: tuple[float, ...] = ()
    quantisation_growth_per_m: float = 0.0
    scale_error: float = 0.0
    distortion_per_m: float = 0.0
    dark_level: float = 0.25
    dark_none_probability: float = 0.0
    shine_deg: float = 8.0
    shine_none_probability: float = 0.0

    def __post_init__(self) -> None:
        check_finite(self)
        if self.quantisation_m < 0 or self.min_range_m < 0 or self.edge_jump_m <= 0:
            raise ValueError("quantisation_m and min_range_m must not be negative, edge_jump_m positive")
        if not 0 <= self.edge_none_probability <= 1:
            raise ValueError(f"edge_none_probability must lie in [0, 1], got {self.edge_none_probability}")
        if not all(-1 < value < 1 for value in self.correlation):
            raise ValueError(f"correlation must lie between -1 and 1, got {self.correlation}")
        for name in ("dark_none_probability", "shine_none_probability"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} must lie in [0, 1), got {getattr(self, name)}")
        if min(self.quantisation_growth_per_m, self.scale_error) < 0:
            raise ValueError("quantisation_growth_per_m and scale_error must not be negative")
        if not 0 <= self.distortion_per_m <= LARGEST_PER_M / 10:
            raise ValueError(
                f"distortion_per_m must lie in [0, {LARGEST_PER_M / 10:g}], got {self.distortion_per_m}"
            )

    @property
    def in_millimetres(self) -> bool:
        """True if every depth is a whole number of millimetres."""
        step_mm = self.quantisation_m * 1000
        whole = step_mm > 0 and bool(np.isclose(step_mm, round(step_mm)))
        return whole and not self.noise_free and self.quantisation_growth_per_m == 0

    def drawn_scale(self, key: jax.Array) -> float:
        """The factor by which a camera of this kind measures too long, the same in all its images."""
        return 1 + self.scale_error * float(jax.random.normal(key)) if self.scale_error > 0 else 1.0

    def drawn_distortion(self, key: jax.Array) -> NDArray[np.float64] | None:
        """The field at its nodes for a camera of this kind, 1/m and of mean zero; None without one."""
        if self.distortion_per_m == 0:
            return None
        field = np.asarray(jax.random.normal(key, (NODE_ROWS, NODE_COLUMNS)), np.float64)
        return self.distortion_per_m * (field - field.mean())

    def measure(
        self,
        key: jax.Array,
        view: View,
        brightness: NDArray[np.floating] | None = None,
        depth_scale: float = 1.0,
        disparity_per_m: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float32]:
        """One depth image (H, W) of an ideal view, in metres, `NO_RETURN` where nothing was measured.

        Args:
            key: of the image's noise.
            view: what an ideal camera sees.
            brightness: (H, W) of the surfaces as shares of white; None is white.
            depth_scale: factor by which the camera's depths are too long, `drawn_scale`.
            disparity_per_m: its distortion field at the nodes, `drawn_distortion`.
        """
        if self.noise_free:
            depth = np.where(np.isfinite(view.depth_m), view.depth_m, NO_RETURN)
            return self._within_range(_distorted(depth, disparity_per_m)).astype(np.float32)
        noise_key, edge_key = jax.random.split(key)
        normals = holes = None
        if self.dark_none_probability > 0 or self.shine_none_probability > 0:
            edge_key, hole_key = jax.random.split(edge_key)
            holes = self._holes(hole_key, view, brightness)
        if self.correlation:
            noise_key, field_key = jax.random.split(noise_key)
            normals = jnp.asarray(correlated_normals(field_key, view.depth_m.shape, self.correlation))
        depth = np.array(sample(noise_key, self.noise, jnp.asarray(view.depth_m), normals))
        depth = _distorted(depth * np.float32(depth_scale), disparity_per_m)
        depth = self._quantised(depth)
        hit = np.isfinite(view.depth_m)
        depth[hit & (view.cos_incidence < np.cos(np.radians(self.grazing_limit_deg)))] = NO_RETURN
        drop = jax.random.bernoulli(edge_key, self.edge_none_probability, depth.shape)
        depth[np.asarray(drop) & self._at_edge(view.depth_m)] = NO_RETURN
        if holes is not None:
            depth[holes] = NO_RETURN
        return self._within_range(depth).astype(np.float32)

    def _quantised(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Depths in steps q + g z^2, even ones by division, as files are read.

        The steps are even in the integral of dz / (q + g z^2), atan(z sqrt(g / q)) / sqrt(q g).
        """
        q, g = self.quantisation_m, self.quantisation_growth_per_m
        if q > 0 and g > 0:
            steps = np.round(np.arctan(depth_m * np.sqrt(g / q)) / np.sqrt(q * g))
            return (np.tan(steps * np.sqrt(q * g)) * np.sqrt(q / g)).astype(np.float32)
        return np.round(depth_m / q) / np.float32(1 / q) if q > 0 else depth_m

    def _holes(
        self, key: jax.Array, view: View, brightness: NDArray[np.floating] | None
    ) -> NDArray[np.bool_]:
        """Blots on dark and on shining surfaces (H, W) that return nothing."""
        height, width = view.depth_m.shape
        holes = np.zeros((height, width), bool)
        dark_key, shine_key = jax.random.split(key)
        if self.dark_none_probability > 0 and brightness is not None:
            blots = clustered(dark_key, (height, width), self.dark_none_probability, HOLE_PX)
            holes |= blots & (brightness < self.dark_level)
        if self.shine_none_probability > 0:
            blots = clustered(shine_key, (height, width), self.shine_none_probability, HOLE_PX)
            holes |= blots & (view.cos_incidence > np.cos(np.radians(self.shine_deg)))
        return holes

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


def _distorted(
    depth_m: NDArray[np.floating], disparity_per_m: NDArray[np.float64] | None
) -> NDArray[np.floating]:
    """Depths (H, W) as a camera measures them whose inverse depths err by a field: 1 / (1 / z + d)."""
    if disparity_per_m is None:
        return depth_m
    rows, columns = pixel_weights(depth_m.shape[1], depth_m.shape[0])
    return (depth_m / (1.0 + (rows @ disparity_per_m @ columns.T) * depth_m)).astype(depth_m.dtype)
