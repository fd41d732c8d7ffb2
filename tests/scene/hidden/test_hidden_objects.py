"""Presence of hidden boxes against brute force: boxes cast by slabs, densities in NumPy, sums over places."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy import stats

from recordings.types import DepthNoise
from scene.hidden.depth_evidence import DepthImages, SeenImage
from scene.hidden.hidden_objects import HiddenPosterior, hidden_posterior
from scene.model.number_prior import BinomialNumber
from scene.objects.scene_object import SceneObject, scene_object
from shapes.geometry.camera import Camera
from tests.statistical import assert_frequencies

HEIGHT, WIDTH, FOCAL, FAR_M, OUTLIERS = 18, 24, 20.0, 2.0, 0.9
NOISE = DepthNoise(
    sigma_base_m=0.05,
    sigma_growth_per_m=0.0,
    outlier_probability=OUTLIERS,
    none_hit_probability=0.0,
    none_miss_probability=0.0,
    max_range_m=FAR_M,
)
SCREEN = np.array([0.0, 0.0, 0.8]), np.array([0.12, 0.1, 0.02])
HALVES_M = np.array([0.03, 0.04, 0.03]), np.array([0.05, 0.03, 0.04])
PLACES = 400


@dataclass(frozen=True)
class GivenPlaces:
    """Upright at these places (n, count, 3), one after the other."""

    places_m: np.ndarray

    def draw(self, rng: np.random.Generator, objects: Sequence[SceneObject], count: int) -> np.ndarray:  # noqa: ARG002
        """All of them; of the object whose half height is told."""
        poses = np.tile(np.eye(4), (len(objects), count, 1, 1))
        for place, one in enumerate(objects):
            poses[place, :, :3, 3] = self.places_m[int(one.name)]
        return poses


def depth_of(boxes: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Depth (H, W) of upright boxes, middle and half size."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - 11.5) / FOCAL, (v - 8.5) / FOCAL, np.ones(u.shape)], axis=-1)
    depth = np.full(u.shape, FAR_M)
    for middle, half in boxes:
        ends = np.sort((middle + np.array([-1, 1])[:, None] * half)[:, None, None] / rays, axis=0)
        near, far = ends[0].max(axis=-1), ends[1].min(axis=-1)
        depth = np.where(near < far, np.minimum(depth, near), depth)
    return depth


def log_density(observed_m: np.ndarray, ideal_m: np.ndarray) -> float:
    """Of supplement L: a uniform share and a normal."""
    normal = stats.norm.pdf(observed_m, ideal_m, NOISE.sigma_base_m)
    return float(np.log(OUTLIERS / FAR_M + (1 - OUTLIERS) * normal).sum())


@pytest.fixture
def places_m(seed: int) -> np.ndarray:
    """Places (2, PLACES, 3) round the screen and behind it, the second behind the first."""
    first = np.random.default_rng(seed).uniform([-0.2, -0.15, 0.5], [0.2, 0.15, 1.0], (PLACES, 3))
    return np.stack([first, first * (1 + 0.2 / first[:, 2:])])


@pytest.fixture
def observed_m(seed: int) -> np.ndarray:
    """The screen alone, with the sensor's noise; no pixel's density is cut at the range's end."""
    rng = np.random.default_rng(seed + 1)
    ideal = depth_of([SCREEN])
    anything = rng.uniform(0, FAR_M, ideal.shape)
    measured = ideal + NOISE.sigma_base_m * rng.standard_normal(ideal.shape)
    return np.where(rng.uniform(size=ideal.shape) < OUTLIERS, anything, np.minimum(measured, FAR_M)).astype(
        np.float32
    )


@pytest.fixture
def images(observed_m: np.ndarray) -> DepthImages:
    """That image, against the screen."""
    camera = Camera(*(jnp.float32(value) for value in (FOCAL, FOCAL, 11.5, 8.5)))
    rest_m = depth_of([SCREEN])[None].astype(np.float32)
    return DepthImages(
        [SeenImage(camera=camera, camera_from_world=np.eye(4), observed_m=observed_m, rest_m=rest_m)], NOISE
    )


@lru_cache(maxsize=1)
def boxes() -> list[SceneObject]:
    """Both hidden objects; their names are their numbers."""
    meshes = [trimesh.creation.box(2 * half) for half in HALVES_M]
    return [scene_object(str(one), mesh.vertices, mesh.faces) for one, mesh in enumerate(meshes)]


def ratios(observed_m: np.ndarray, places_m: np.ndarray, objects: Sequence[int]) -> np.ndarray:
    """Likelihood ratios (PLACES,) of these objects together."""
    alone = log_density(observed_m, depth_of([SCREEN]))
    scenes = [[SCREEN, *((places_m[one, at], HALVES_M[one]) for one in objects)] for at in range(PLACES)]
    return np.exp([log_density(observed_m, depth_of(scene)) - alone for scene in scenes])


def of_one(seed: int, places_m: np.ndarray, images: DepthImages, keep: int = 256) -> HiddenPosterior:
    """The posterior of the first box over these places (1, PLACES, 3), with presence 0.9 a priori."""
    rng, prior = np.random.default_rng(seed), GivenPlaces(places_m)
    return hidden_posterior(rng, boxes()[:1], prior, images, BinomialNumber(0.9), draws=PLACES, keep=keep)


def test_one_hidden_object(
    seed: int, places_m: np.ndarray, observed_m: np.ndarray, images: DepthImages
) -> None:
    """P = 9 m / (1 + 9 m), and its places are drawn in proportion to their ratios."""
    brute = ratios(observed_m, places_m, [0])

    found = of_one(seed, places_m, images, keep=4000)

    assert abs(found.ratios[(0,)].mean - brute.mean()) < 0.02 * brute.mean()
    expected = 9 * brute.mean() / (1 + 9 * brute.mean())
    assert abs(found.presence[0] - expected) < 0.01
    behind = found.poses[0, :, 2, 3] > 0.9
    share = brute[places_m[0, :, 2] > 0.9].sum() / brute.sum()
    assert_frequencies([behind.sum(), (~behind).sum()], [share, 1 - share])


@pytest.mark.slow
def test_two_hidden_objects_hide_each_other(
    seed: int, places_m: np.ndarray, observed_m: np.ndarray, images: DepthImages
) -> None:
    """Sums over all four sets; where one is before the other, the pixels they share count once."""
    first, second, together = (ratios(observed_m, places_m, which).mean() for which in ([0], [1], [0, 1]))
    weights = np.array([0.01, 0.09 * first, 0.09 * second, 0.81 * together])
    independent = np.mean(ratios(observed_m, places_m, [0]) * ratios(observed_m, places_m, [1]))
    assert abs(together - independent) > 0.05 * together

    found = hidden_posterior(
        np.random.default_rng(seed), boxes(), GivenPlaces(places_m), images, BinomialNumber(0.9), draws=PLACES
    )

    assert abs(found.ratios[(0, 1)].mean - together) < 0.03 * together
    presence = weights[[1, 3]].sum() / weights.sum(), weights[[2, 3]].sum() / weights.sum()
    np.testing.assert_allclose(found.presence, presence, atol=0.01)
    np.testing.assert_allclose(found.both, weights[3] / weights.sum(), atol=0.015)


def test_the_standard_error_is_that_of_repeats(seed: int, images: DepthImages) -> None:
    """Over 40 repeats presence spreads as told: within a factor of 1.6, missed once in 1e4 (chi-square)."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(40):
        places = rng.uniform([-0.2, -0.15, 0.5], [0.2, 0.15, 1.2], (1, 256, 3))
        prior = GivenPlaces(places)
        found.append(hidden_posterior(rng, boxes()[:1], prior, images, BinomialNumber(0.9), draws=256))

    told = np.sqrt(np.mean([one.standard_error[0] ** 2 for one in found]))
    assert told / 1.6 < np.std([one.presence[0] for one in found], ddof=1) < told * 1.6


def test_what_lies_outside_every_image_is_told(seed: int, images: DepthImages) -> None:
    """Half of the places are beside the image, half behind the screen: nothing speaks against any."""
    places = np.zeros((1, PLACES, 3))
    places[0, :, 2] = 1.0
    places[0, ::2, 0] = 3.0

    found = of_one(seed, places, images)

    assert abs(found.ratios[(0,)].mean - 1) < 1e-6
    outside = ~images.seen(found.poses[0, :, :3, 3])
    np.testing.assert_allclose(outside.mean(), 0.5, atol=0.15)  # of 256: 4.8 standard deviations


def test_what_would_be_seen_everywhere_is_not_there(
    seed: int, images: DepthImages, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every place is 2,000 nats worse, too little for a number: presence 0, and no error."""
    monkeypatch.setattr(DepthImages, "log_ratios", lambda *given: np.full(len(given[2]), -2000.0))
    places = np.ones((1, PLACES, 3))

    found = of_one(seed, places, images)

    assert found.ratios[(0,)].mean == 0
    assert found.presence[0] == 0
    assert found.standard_error[0] == 0


def test_what_is_in_plain_sight_is_there(
    seed: int, images: DepthImages, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every place is 2,000 nats better, too much for a number: presence 1, and no error."""
    monkeypatch.setattr(DepthImages, "log_ratios", lambda *given: np.full(len(given[2]), 2000.0))

    found = of_one(seed, np.ones((1, PLACES, 3)), images)

    assert found.presence[0] == 1
    assert found.standard_error[0] == 0
    assert np.isfinite(found.ratios[(0,)].mean)


def test_three_objects_are_told_what_they_would_cost(seed: int, images: DepthImages) -> None:
    """One line says how many sets there are."""
    three = [replace(boxes()[0], name=str(one)) for one in range(3)]

    with pytest.raises(ValueError, match="not 3: 7 sets of them"):
        hidden_posterior(
            np.random.default_rng(seed),
            three,
            GivenPlaces(np.zeros((3, 1, 3))),
            images,
            BinomialNumber(0.9),
            draws=1,
        )
