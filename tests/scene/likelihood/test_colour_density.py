"""The factor of colours is a density, looks back alone, and counts what is alike once."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from recordings.types import CameraIntrinsics
from scene.likelihood.colour_density import GAIN_SD, WRONG, ColourDensity, log_unknown, window_colours
from scene.objects.surface_colour import COMPONENTS, DARK, components_of_light
from scene.observation.pixel_window import window_of

GAIN = jnp.asarray(GAIN_SD)


log_factor = jax.jit(ColourDensity.log_factor)


def image(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Colours (H, W, 3) of patches of four pixels, with a little noise."""
    height, width = shape
    patches = rng.normal(scale=0.6, size=(-(-height // 4), -(-width // 4), 3))
    rough = np.repeat(np.repeat(patches, 4, axis=0), 4, axis=1)[:height, :width]
    return rough + rng.normal(scale=0.05, size=(height, width, 3))


def density_of(observed: np.ndarray) -> ColourDensity:
    """Of colours (H, W, 3) that are all known."""
    return ColourDensity.of(observed, np.ones(observed.shape[:2], bool))


def log_sum(model: np.ndarray, density: ColourDensity) -> float:
    """Of a surface that covers the whole window and is seen for certain."""
    return float(jnp.sum(log_factor(density, jnp.asarray(model), jnp.ones(model.shape[:2]), GAIN)))


@pytest.mark.parametrize("pixel", [(0, 0), (1, 2), (2, 3)])
def test_every_pixel_integrates_to_one(pixel: tuple[int, int], seed: int) -> None:
    """Given the pixels before: the sum over a grid of colours, by the trapezoid rule, is 1 within 1e-3."""
    rng = np.random.default_rng(seed)
    learned = density_of(image(rng, (16, 16)))
    wide = ColourDensity(
        observed=learned.observed[:3, :4],
        known=learned.known[:3, :4],
        weights=learned.weights,
        scales=jnp.maximum(learned.scales, 0.25),
        mean=learned.mean,
        log_unknown=learned.log_unknown[:3, :4],
    )
    model = jnp.asarray(rng.normal(scale=0.5, size=(3, 4, 3)), jnp.float32)
    shows = jnp.asarray(rng.uniform(0.2, 1, (3, 4)), jnp.float32)
    steps = np.linspace(-6, 6, 61)
    log_density = jax.jit(jax.vmap(lambda colour: _log_density(wide, pixel, colour, model, shows)))
    total = 0.0
    for first in steps:
        tried = np.stack(np.meshgrid(first, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        total += float(np.exp(np.asarray(log_density(jnp.asarray(tried, jnp.float32)))).sum())
    assert total * (steps[1] - steps[0]) ** 3 == pytest.approx(1, abs=1e-3)


def _log_density(
    density: ColourDensity, pixel: tuple[int, int], colour: jax.Array, model: jax.Array, shows: jax.Array
) -> jax.Array:
    """Log density of a colour (3,) of one pixel: u and the factor over it."""
    observed = density.observed.at[pixel].set(colour)
    numbers = density.weights, density.scales, density.mean
    unknown = log_unknown(observed, density.known, *numbers)
    changed = ColourDensity(observed, density.known, *numbers, unknown)
    return (unknown + log_factor(changed, model, shows, GAIN))[pixel]


def test_no_factor_looks_ahead(seed: int) -> None:
    """Factors of the pixels before one do not change with its colour; its own and later ones do."""
    rng = np.random.default_rng(seed)
    observed = image(rng, (8, 8))
    density = density_of(observed)
    model, shows = jnp.zeros((8, 8, 3)), jnp.ones((8, 8))
    before = np.asarray(log_factor(density, model, shows, GAIN)).ravel()
    changed = ColourDensity(
        observed=density.observed.at[4, 4].add(0.5),
        known=density.known,
        weights=density.weights,
        scales=density.scales,
        mean=density.mean,
        log_unknown=density.log_unknown,
    )
    after = np.asarray(log_factor(changed, model, shows, GAIN)).ravel()
    assert np.array_equal(before[:36], after[:36])
    assert before[36] != after[36]
    assert before[37] != after[37]


def test_one_wrong_colour_is_paid_for_once(seed: int) -> None:
    """A flat thing of sixteen times as many pixels in another light costs no more; its right colour gains.

    Sums over the pixels by themselves would differ by a factor of sixteen; outlines are four times as long.
    """
    rng = np.random.default_rng(seed)
    costs, gains = [], []
    for side in (8, 32):
        observed = rng.normal(scale=0.03, size=(48, 48, 3)) + np.array([0.5, 0.6, -0.5])
        observed[8 : 8 + side, 8 : 8 + side] += [0.3, -1.2, 0.9]
        density = density_of(observed)
        shows = np.zeros((48, 48))
        shows[8 : 8 + side, 8 : 8 + side] = 1
        right = np.broadcast_to([0.8, -0.6, 0.4], (48, 48, 3))
        for model, sums in ((right, gains), (right - [0, -1.0, 1.0], costs)):
            sums.append(float(jnp.sum(log_factor(density, jnp.asarray(model), jnp.asarray(shows), GAIN))))
    assert min(costs) > math.log(WRONG) - 0.1
    assert max(costs) < -1
    assert min(gains) > 1
    assert max(gains) < 4 * min(gains)


def test_of_a_wrong_colour_no_light_is_learned(seed: int) -> None:
    """A thing of one colour far from the model's, in an image of sharp colours: the model is held against it.

    A light that made up for the difference would be 10 standard deviations from none; neighbours that differ
    from the model alike must not pass for such a light, however many they are.
    """
    rng = np.random.default_rng(seed)
    observed = rng.normal(scale=0.01, size=(24, 24, 3))
    observed[4:20, 4:20] += np.array([0.0, 2.0, 1.0])
    density, shows = density_of(observed), np.zeros((24, 24))
    shows[4:20, 4:20] = 1.0

    def log_sum_of(colour: list[float]) -> float:
        model = jnp.broadcast_to(jnp.asarray(colour), (24, 24, 3))
        return float(jnp.sum(log_factor(density, model, jnp.asarray(shows), GAIN)))

    assert log_sum_of([0.0, 2.0, 1.0]) > 0
    assert log_sum_of([0.0, 0.0, -1.0]) == pytest.approx(math.log(WRONG), abs=0.1)


def test_a_texture_in_its_place_tells_from_one_beside(seed: int) -> None:
    """A pattern earns what its edges do; shifted by two pixels, or in other colours, it costs."""
    rng = np.random.default_rng(seed)
    own = image(rng, (40, 40))
    density = density_of(own + np.array([0.4, 0.1, -0.1]) + rng.normal(scale=0.05, size=own.shape))
    right, beside = (log_sum(model, density) for model in (own, np.roll(own, 2, axis=1)))
    another = log_sum(image(rng, (40, 40)), density)
    assert right > 50
    assert beside < 0
    assert another < 0
    assert another > -0.15 * own[..., 0].size


def test_gain_of_the_light_is_added(seed: int) -> None:
    """Light times a constant per channel moves colours by one constant, well above the darkest."""
    rng = np.random.default_rng(seed)
    rgb = rng.integers(120, 200, (5, 3))
    light = (rgb / 255) ** 2.2
    moved = np.log(light * [1.2, 0.9, 0.8] + DARK) @ COMPONENTS.T - components_of_light((rgb / 255) ** 2.2)
    assert moved == pytest.approx(np.tile(np.log([1.2, 0.9, 0.8]) @ COMPONENTS.T, (5, 1)), abs=0.02)


def test_clipped_pixels_are_not_known() -> None:
    """Nor those that the colour camera did not see; a window's pixel is the mean of those it stands for."""
    intrinsics = CameraIntrinsics(width=240, height=180, fx=200, fy=200, cx=120, cy=90)
    window = window_of(np.ones((180, 240), np.float32), intrinsics)
    rgb = np.full((180, 240, 3), 100, np.uint8)
    row, column = int(window.rows[40]), int(window.columns[40])
    rgb[row, column] = 255
    seen = np.ones((180, 240), bool)
    seen[int(window.rows[41]), column] = False
    colours, known = window_colours(rgb, seen, window, 2.2)
    assert not known[40, 40]
    assert not known[41, 40]
    assert known[42, 40]
    assert colours[42, 42] == pytest.approx(components_of_light((np.full(3, 100) / 255) ** 2.2), abs=1e-6)
