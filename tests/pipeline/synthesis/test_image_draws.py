"""Images drawn pixel by pixel have the density by which scenes are compared."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.typing import ArrayLike

from pipeline.synthesis.image_draws import REACH_PX, drawn_image
from recordings.types import NO_RETURN, DepthNoise
from scene.likelihood.pixel_density import PixelDensity
from scene.likelihood.unknown_surfaces import EDGES, UnknownWeights
from tests.scene.likelihood.whole_image import of_object
from tests.statistical import assert_mean

SURFACE_M, EDGE_REACH = 0.01, 0.6
NOISE = DepthNoise(
    sigma_base_m=0.02,
    sigma_growth_per_m=0.0,
    none_hit_probability=0.1,
    none_miss_probability=0.7,
    max_range_m=2.0,
)
CALM, ASTIR = [0.2, 0.1, 0.1, 0.1, 0.15, 0.1, 0.1, 0.15], [0.1, 0.1, 0.15, 0.05, 0.2, 0.1, 0.15, 0.15]
LEARNED = UnknownWeights(
    weights=jnp.array([CALM] * EDGES + [ASTIR] * EDGES, jnp.float32),
    scales=jnp.array([1.0, 1.05, 1.1, 1.15, 1.2, 1.1, 1.05], jnp.float32),
    reach_m=1.3,
)
REST_M = np.full((4, 5), 0.9, np.float32)
REST_M[:, 4] = np.inf
NEAR_M, FAR_M = (np.full((4, 5), np.inf, np.float32) for _ in range(2))
NEAR_M[1:3, 1:3], FAR_M[2:, 2:4] = 0.6, 0.7


def log_image(
    observed_m: jax.Array, layers_m: ArrayLike, rest_m: ArrayLike, noise: DepthNoise = NOISE
) -> jax.Array:
    """Log density of an image (H, W) of objects (L, H, W)."""
    numbers = noise, jnp.float32(SURFACE_M), jnp.float32(EDGE_REACH), LEARNED
    density = PixelDensity.of_image(observed_m, jnp.asarray(rest_m), *numbers)
    shown, depth_m = jax.lax.map(lambda layer_m: of_object(density, layer_m), jnp.asarray(layers_m))
    nearest = jnp.argmin(depth_m, axis=0)[None]
    mine, there = (jnp.take_along_axis(part, nearest, axis=0)[0] for part in (shown, depth_m))
    return jnp.where(jnp.isfinite(there), mine, density.log_rest)


@pytest.mark.slow
def test_ratios_of_densities_have_mean_one(key: jax.Array) -> None:
    """Of other scenes' and sensors' densities to that of the images' own: two objects, a support that ends.

    Every cause, outline and neighbour is in the ratio; 400 images of 20 pixels; a false alarm in 1e-6 of runs
    with correct code. The means' standard errors are 0.005 to 0.03.
    """
    layers_m = np.stack([NEAR_M, FAR_M])
    images = np.stack(
        [
            drawn_image(one, layers_m, REST_M, NOISE, SURFACE_M, EDGE_REACH, LEARNED)
            for one in jax.random.split(key, 400)
        ]
    )
    scenes = (
        (layers_m, REST_M, NOISE),
        (layers_m + np.float32(0.002), REST_M, NOISE),
        (layers_m, REST_M + np.float32(0.003), NOISE),
        (layers_m, REST_M, replace(NOISE, sigma_base_m=0.0203)),
        (layers_m, REST_M, replace(NOISE, none_hit_probability=0.11, none_miss_probability=0.68)),
    )
    every = jax.tree.map(lambda *leaves: jnp.stack([jnp.float32(leaf) for leaf in leaves]), *scenes)

    def log_density(image: jax.Array) -> jax.Array:
        return jax.lax.map(lambda scene: jnp.sum(log_image(image, *scene)), every)

    found = np.asarray(jax.jit(jax.vmap(log_density))(images), np.float64)

    assert_mean(np.exp(found[:, 1:] - found[:, :1]), 1.0, detectable=0.2)


def test_a_factor_looks_no_further_than_the_patch_in_which_it_is_drawn(seed: int) -> None:
    """Pixels beyond it are measured otherwise, on creases and holes: the factor stays as it is."""
    rng = np.random.default_rng(seed)
    size = 24, 32
    observed_m = (0.9 + 0.02 * rng.standard_normal(size)).astype(np.float32)
    observed_m[5:15, 8:20] -= 0.2
    observed_m[rng.random(size) < 0.05] = NO_RETURN
    rest_m = np.full(size, 0.9, np.float32)
    layers_m = np.full((1, *size), np.inf, np.float32)
    layers_m[0, 6:16, 9:21] = 0.7
    factors = jax.jit(lambda image: log_image(image, layers_m, rest_m))
    before = np.asarray(factors(observed_m))
    for row, column in rng.integers((REACH_PX, REACH_PX), (24, 32 - REACH_PX), (30, 2)):
        changed = (0.9 + 0.3 * rng.standard_normal(size)).astype(np.float32)
        near = np.s_[row - REACH_PX : row + 1, column - REACH_PX : column + REACH_PX + 1]
        changed[near] = observed_m[near]
        assert factors(changed)[row, column] == pytest.approx(before[row, column], abs=1e-4)
