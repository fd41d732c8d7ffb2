"""What colours tell of layers, each in a crop of its own."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from recordings.types import DepthNoise
from scene.likelihood import colour_layers
from scene.likelihood.colour_density import ColourDensity
from scene.likelihood.colour_layers import ColourLayers, ColourTables
from scene.likelihood.pixel_density import PixelDensity
from shapes.geometry.camera import Camera

HEIGHT, WIDTH, CELLS = 90, 120, 10


def painted_layers(rng: np.random.Generator, size: tuple[int, int] = (HEIGHT, WIDTH)) -> ColourLayers:
    """Of two painted cubes of 40 cm before a wall one metre away, which the image shows in other colours."""
    observed_m = rng.normal(1.0, 0.003, size).astype(np.float32)
    depth = PixelDensity.of(observed_m, np.ones_like(observed_m), DepthNoise(), 0.003, 2)
    colours = rng.normal(scale=0.6, size=(*size, 3))
    tables = ColourTables(
        values=jnp.asarray(rng.normal(scale=0.6, size=(2 * CELLS**3, 3)), jnp.float32),
        first=jnp.array([0, CELLS**3], jnp.int32),
        size=jnp.full((2, 3), CELLS, jnp.int32),
        origin_m=jnp.full((2, 3), -0.2),
        pitch_m=jnp.full(2, 0.4 / CELLS),
        gain_sd=jnp.full((2, 3), 0.3),
    )
    camera = Camera(*map(jnp.float32, (140.0, 140.0, size[1] / 2, size[0] / 2)))
    known = np.ones(size, bool)
    return ColourLayers(ColourDensity.of(colours, known), depth, tables, camera)


def test_a_crop_tells_what_the_whole_window_does(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Objects small and large, at the border and beyond it, and one that is not seen: all but rounding."""
    rng = np.random.default_rng(seed)
    with jax.enable_x64(False):
        layers = painted_layers(rng)
    layers_m = np.full((16, HEIGHT, WIDTH), np.inf, np.float32)
    for layer_m in layers_m[1:]:
        row, column, down, across = *rng.integers((-20, -20), (HEIGHT, WIDTH)), *rng.integers(2, 100, 2)
        layer_m[max(row, 0) : max(row + down, 0), max(column, 0) : max(column + across, 0)] = 0.99
    numbers, poses = np.arange(16) % 2, np.tile([1.0, 0, 0, 0, 0, 0, 1.0], (16, 1))

    with jax.enable_x64(False):  # as the search has it
        cropped = np.asarray(layers.log_factors(numbers, poses, layers_m))
        monkeypatch.setattr(colour_layers, "CROPS", ())
        jax.clear_caches()  # else the kernel with crops would serve again
        whole = np.asarray(layers.log_factors(numbers, poses, layers_m))
    jax.clear_caches()

    assert np.abs(whole).max() > 0.1
    np.testing.assert_allclose(cropped, whole, atol=2e-3)


def test_turns_are_told_in_a_window_of_few_pixels(seed: int) -> None:
    """Of fewer than are compared: the wall in the colours of a cube that was turned by half."""
    size = 12, 16
    with jax.enable_x64(False):
        layers = painted_layers(np.random.default_rng(seed), size)
        layer_m = np.full(size, 0.999, np.float32)
        pose = np.eye(4, dtype=np.float32)
        pose[2, 3] = 1.1
        turns = np.stack([np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0])]).astype(np.float32)
        shown = colour_layers._in_box(layers.camera, jnp.asarray(pose @ turns[1]), jnp.asarray(layer_m))
        observed = layers.tables.at(jnp.int32(1), shown)
        layers = replace(layers, density=replace(layers.density, observed=observed))
        best = colour_layers._best_turns(layers, np.int32(1), turns, pose[None], layer_m[None])
    assert best.tolist() == [1]
