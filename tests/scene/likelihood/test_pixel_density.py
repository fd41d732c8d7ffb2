"""The one density of an image sums to one over all images, and its sampler draws from it."""

from collections.abc import Callable, Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from recordings.types import NO_RETURN, DepthNoise
from scene.likelihood import unknown_surfaces
from scene.likelihood.object_density import layer_densities, object_densities
from scene.likelihood.pixel_density import PixelDensity
from scene.likelihood.pixel_factors import MISSING, MISSING_ON, OUTLIERS
from scene.likelihood.pixel_places import ImageParts
from scene.likelihood.unknown_surfaces import EDGES, EarlierWeights, UnknownWeights
from tests.scene.likelihood.whole_image import of_object

STEP_M, SENSOR_M, SURFACE_M = 0.07, 0.08, 0.05
DEPTHS_M = STEP_M * (np.arange(30) - 6.5)
"""Middles of cells, of which some begin at 0 and at the reach: sums over them are exact to rounding."""
REACH_M = 18 * STEP_M
NOISE = DepthNoise(
    sigma_base_m=SENSOR_M,
    sigma_growth_per_m=0.0,
    none_hit_probability=0.1,
    none_miss_probability=0.7,
    max_range_m=REACH_M,
)
WEIGHTS, ASTIR = [0.2, 0.1, 0.1, 0.1, 0.15, 0.1, 0.1, 0.15], [0.1, 0.1, 0.15, 0.05, 0.2, 0.1, 0.15, 0.15]
WEIGHTS_EARLIER, SCALES_EARLIER = [0.4, 0.7], [0.9, 1.1]
LEARNED = UnknownWeights(
    weights=jnp.array([WEIGHTS] * EDGES + [ASTIR] * EDGES),
    scales=jnp.array([1.0, 1.05, 1.1, 1.15, 1.2, 1.1, 1.05]),
    reach_m=REACH_M,
    earlier=EarlierWeights(weights=jnp.array(WEIGHTS_EARLIER), scales=jnp.array(SCALES_EARLIER)),
)
INF = np.inf
SCENES = {
    "an object that ends between the columns": (
        [[0.5, INF], [0.52, INF]],
        [[0.8, 0.8], [0.7, 0.7]],
        None,
    ),
    "one in the corner, a support that ends": ([[INF, INF], [INF, 0.6]], [[0.8, INF], [0.7, 0.7]], None),
    "an earlier frame saw the object, the support, nothing, what is before it": (
        [[0.5, INF], [0.52, 0.6]],
        [[0.8, 0.8], [0.7, 0.7]],
        [[0.55, 0.75], [NO_RETURN, 0.35]],
    ),
}


@pytest.fixture(autouse=True, scope="module")
def near_predictions() -> Iterator[None]:
    """Planes foretell no depths whose densities would reach beyond the cells."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(unknown_surfaces, "FARTHEST_M", 1.1)
        yield


@jax.jit
def log_factors(
    observed_m: jax.Array, layer_m: jax.Array, rest_m: jax.Array, earlier_m: jax.Array | None
) -> jax.Array:
    """Log density (2, 2) of the pixels of an image under a scene of one object, given an earlier frame."""
    numbers = NOISE, jnp.float32(SURFACE_M), jnp.float32(0.6), LEARNED
    density = PixelDensity.of_image(observed_m, rest_m, *numbers, earlier_m)
    shown, depth_m = of_object(density, layer_m)
    return jnp.where(jnp.isfinite(depth_m), shown, density.log_rest)


def images() -> np.ndarray:
    """All images (31^4, 2, 2) of 30 depths and the atom."""
    values = np.append(DEPTHS_M, NO_RETURN)
    return np.stack(np.meshgrid(*[values] * 4, indexing="ij"), axis=-1).reshape(-1, 2, 2)


@pytest.mark.parametrize(
    "scene",
    [
        name if given is not None else pytest.param(name, marks=pytest.mark.slow)
        for name, (*_, given) in SCENES.items()
    ],
)
def test_all_images_sum_to_one(scene: str) -> None:
    """Outlines, labels, correlated residuals, the atom and earlier frames included, within 1e-6."""
    with jax.enable_x64(True):
        layer_m, rest_m, earlier_m = (None if part is None else jnp.asarray(part) for part in SCENES[scene])
        factors: Callable = jax.jit(jax.vmap(lambda image: log_factors(image, layer_m, rest_m, earlier_m)))
        total = 0.0
        for part in np.array_split(images(), 16):
            cells = np.where(part == NO_RETURN, 1.0, STEP_M).prod(axis=(1, 2))
            total += float((cells * np.exp(np.asarray(factors(part)).sum(axis=(1, 2)))).sum())
    assert abs(total - 1) < 1e-6


def test_no_factor_looks_ahead(seed: int) -> None:
    """A pixel's factor stays as it is when a later pixel is measured otherwise."""
    rng = np.random.default_rng(seed)
    layer_m = jnp.asarray(np.where(rng.random((6, 8)) < 0.6, 0.6, np.inf))
    image, rest_m = rng.uniform(0.3, 1.0, (6, 8)), jnp.full((6, 8), 0.9)
    earlier_m = jnp.asarray(rng.uniform(0.3, 1.0, (6, 8)))
    before = log_factors(jnp.asarray(image), layer_m, rest_m, earlier_m)
    for row, column in ((0, 3), (2, 5), (5, 7)):
        other = image.copy()
        other[row, column] = rng.uniform(0.3, 1.0)
        after = log_factors(jnp.asarray(other), layer_m, rest_m, earlier_m)
        earlier = np.arange(48).reshape(6, 8) < row * 8 + column
        np.testing.assert_array_equal(np.asarray(before)[earlier], np.asarray(after)[earlier])
        assert before[row, column] != after[row, column]


def test_a_plane_of_which_much_was_seen_is_known_as_well_as_a_shape(seed: int) -> None:
    """That the inside of a flat thing is flat speaks for no object: less than 0.1 nat a pixel does.

    The mean over some 600 pixels whose gains have a standard deviation of 0.3: a false alarm is out of reach.
    """
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:48, :48]
    plane_m = (1 / (1.1 + 0.004 * columns + 0.006 * rows)).astype(np.float32)
    layer_m = np.where((rows >= 6) & (columns >= 6), plane_m, np.inf).astype(np.float32)
    noise = DepthNoise(sigma_base_m=0.002, sigma_growth_per_m=0.0)
    observed_m = np.where(np.isfinite(layer_m), plane_m + rng.normal(0, 0.002, plane_m.shape), 1.2)
    rest_m = np.full(plane_m.shape, 1.2, np.float32)
    density = PixelDensity.of(observed_m.astype(np.float32), rest_m, noise, 0.003, 1)
    gains = np.asarray(jax.jit(of_object)(density, layer_m)[0] - density.log_rest)
    inside = (rows >= 14) & (columns >= 14) & (rows < 46) & (columns < 40)
    assert abs(gains[inside].mean()) < 0.1


@pytest.mark.parametrize("size", [(84, 112), (1, 40)], ids=["an image", "a row"])
def test_lists_of_pixels_give_what_the_whole_image_does(seed: int, size: tuple[int, int]) -> None:
    """Objects small and large, at the border and beyond it, none, holes, two sensors: all but rounding."""
    rng, densities = np.random.default_rng(seed), []
    for noise in (DepthNoise(), DepthNoise(sigma_base_m=0.002, none_miss_probability=0.8)):
        observed_m = rng.normal(1.0, 0.003, size).astype(np.float32)
        observed_m[20:40, 30:50] -= 0.1
        observed_m[rng.random(size) < 0.05] = NO_RETURN
        densities.append(PixelDensity.of(observed_m, np.ones(size, np.float32), noise, 0.003, 4))
    layers_m = np.full((24, *size), np.inf, np.float32)
    for layer_m in layers_m[1:]:
        row, column, down, across = *rng.integers((-20, -20), size), *rng.integers(2, 90, 2)
        layer_m[max(row, 0) : max(row + down, 0), max(column, 0) : max(column + across, 0)] = rng.uniform(
            0.8, 1.1
        )
    frames = np.arange(24, dtype=np.int32) % 2
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), *densities)
    log_listed, depth_listed = jax.jit(object_densities)(both, layers_m, ImageParts(frames))
    for frame, density in enumerate(densities):
        mine = frames == frame
        log_whole, depth_m = jax.jit(partial(jax.lax.map, partial(of_object, density)))(layers_m[mine])
        np.testing.assert_array_equal(depth_listed[mine], depth_m)
        expected = np.where(np.isfinite(depth_m), log_whole, 0.0)
        np.testing.assert_allclose(np.asarray(log_listed)[mine], expected, atol=1e-5)


@pytest.mark.parametrize("size", [(84, 112), (70, 38)], ids=["an image", "a narrow one"])
def test_a_part_of_an_image_tells_what_the_whole_does(seed: int, size: tuple[int, int]) -> None:
    """Objects that fill a part, or more, at every border, in two pieces, none: all but rounding."""
    rng = np.random.default_rng(seed)
    observed_m = rng.normal(1.0, 0.003, size).astype(np.float32)
    observed_m[20:40, 10:30] -= 0.1
    observed_m[rng.random(size) < 0.05] = NO_RETURN
    density = PixelDensity.of(observed_m, np.full(size, 1.05, np.float32), DepthNoise(), 0.003, 4)
    layers_m = np.full((80, *size), np.inf, np.float32)
    for layer_m in layers_m[1:]:
        for _ in range(rng.integers(1, 3)):
            row, column, down, across = *rng.integers((-10, -10), size), *rng.integers(2, 50, 2)
            near = slice(max(row, 0), max(row + down, 0)), slice(max(column, 0), max(column + across, 0))
            layer_m[near] = rng.uniform(0.8, 1.1) + 0.001 * np.arange(size[1])[near[1]]
    log_parts, depth_parts = layer_densities(density, layers_m)
    frames = np.zeros(len(layers_m), np.int32)
    log_whole, depth_whole = jax.jit(object_densities)(density.stacked(), layers_m, ImageParts(frames))

    np.testing.assert_array_equal(depth_parts, depth_whole)
    np.testing.assert_allclose(log_parts, log_whole, atol=1e-4)  # rounding of other kernels: 3e-5


@pytest.mark.parametrize("earlier_m", [NO_RETURN, 0.6, 0.75], ids=["alone", "shown", "behind it"])
def test_the_sampler_draws_from_it(seed: int, earlier_m: float) -> None:
    """Pixels drawn cause by cause have the density's distribution: the atom, then ten classes of depth.

    The object ends between two pixels of a row, whose first shows it; what an earlier frame has measured in
    place of the second is the object, something behind it or nothing. 200,000 draws, every class within
    4.5 standard errors: a false alarm in 3e-4 of all runs.
    """
    rng, count = np.random.default_rng(seed), 200_000
    layer_m, rest_m = jnp.array([[0.5, 0.52]]), jnp.array([[1.2, 1.2]])
    first, earlier = 0.53, jnp.array([[NO_RETURN, earlier_m]])
    drawn = _drawn(rng, count, first, 0.52, earlier_m)
    edges = np.linspace(-0.4, 1.6, 11)
    fine = (np.arange(4000) + 0.5) / 4000 * 2.0 - 0.4
    values = jnp.asarray(np.append(fine, NO_RETURN))
    with jax.enable_x64(True):
        drawn_images = jnp.stack([jnp.full(len(values), first), values], axis=1)[:, None]
        factors = jax.jit(jax.vmap(log_factors, in_axes=(0, None, None, None)))
        density = np.exp(np.asarray(factors(drawn_images, layer_m, rest_m, earlier))[:, 0, 1])
    expected = np.append(density[:-1].reshape(10, 400).sum(axis=1) * 2.0 / 4000, density[-1])
    counted = np.append(np.histogram(drawn[drawn != NO_RETURN], edges)[0], (drawn == NO_RETURN).sum())
    error = np.sqrt(expected * (1 - expected) / count)
    assert (np.abs(counted / count - expected) < 4.5 * error + 1e-5).all()


def _drawn(
    rng: np.random.Generator, count: int, first: float, depth_m: float, earlier_m: float
) -> np.ndarray:
    """Draws (count,) of the second of two pixels on an object, 0.5 m and `depth_m` off; one shows `first`."""
    weights, scales = np.array(WEIGHTS), np.asarray(LEARNED.scales)
    sigma = float(np.hypot(SENSOR_M, SURFACE_M))

    def shows(value: float, at: float) -> float:
        agrees = float(norm.pdf(value, at, sigma))
        return agrees / (agrees + 1 / REACH_M)

    shown_first, shown_earlier = shows(first, 0.5), shows(earlier_m, depth_m)
    near, apart = (0.0, 0.0) if earlier_m == NO_RETURN else np.asarray(WEIGHTS_EARLIER)  # all within 3 sigma

    def by_earlier(size: float | np.ndarray) -> np.ndarray:
        return rng.random(count) < size

    def seen_again() -> np.ndarray:
        return rng.normal(earlier_m, SENSOR_M * SCALES_EARLIER[0], count)

    def unknown() -> np.ndarray:
        kinds = np.array([0, 2, 4, 5])  # the plane, the pixel to the left, either plane, and what begins
        kind = rng.choice(kinds, count, p=weights[kinds] / weights[kinds].sum())
        again = by_earlier(near)
        shown = np.where(again, shown_earlier, shown_first)
        begins = (~again & (kind == 5)) | (rng.random(count) < shown)  # none continues the object's
        spread = SENSOR_M * scales[np.minimum(kind, 4)]
        goes_on = np.where(again, seen_again(), rng.normal(first, spread))
        return np.where(begins, rng.uniform(0, REACH_M, count), goes_on)

    shares = shown_first * np.array([weights[0] + weights[1], weights[2], weights[4]])
    kind = rng.choice(4, count, p=[*shares, 1 - shares.sum()])
    told = kind < 3
    spread = np.append(SENSOR_M * scales[[0, 2, 4]], sigma)[kind]
    surface = rng.normal(depth_m + np.where(told, first - 0.5, 0.0), spread)
    surface = np.where(by_earlier(near * shown_earlier), seen_again(), surface)
    surface = np.where(rng.random(count) < OUTLIERS, rng.uniform(0, REACH_M, count), surface)
    by_first = MISSING + (MISSING_ON - MISSING) * (1 - shown_first) / 2
    ended = MISSING + (1 - 2 * MISSING) * (1 - shown_earlier) * (earlier_m > depth_m)
    missing = rng.random(count) < np.where(by_earlier(apart), ended, by_first)
    surface = np.where(missing, unknown(), surface)
    thing, kappa = unknown(), 0.05 + 0.9 * (1 - shown_first)
    kappa = np.where(by_earlier(apart), 0.05**2 + (1 - 2 * 0.05**2) * (1 - shown_earlier), kappa)
    in_front = (rng.random(count) < kappa) & (rng.random(count) < norm.cdf((depth_m - thing) / sigma))
    return np.where(rng.random(count) < 0.1, NO_RETURN, np.where(in_front, thing, surface))
