"""The depth-image likelihood against float64 NumPy on the same rendered images."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy import stats

from recordings.types import DepthNoise
from scene.likelihood.one_object import DepthEvidence, depth_evidence, gain_over_rest, log_likelihood_ratio
from shapes.rendering.depth_rendering import render_layers
from shapes.rendering.object_library import ObjectLibrary, join, library_of_mesh
from shapes.rendering.ray_casting import PosedObjects
from tests.shapes.views import INTRINSICS, cameras, posed, random_views

HEIGHT, WIDTH = INTRINSICS.height, INTRINSICS.width
NOISE = DepthNoise(outlier_probability=0.02)
COMPARED = 60


@pytest.fixture(scope="module")
def mesh() -> trimesh.Trimesh:
    """A box with a leg: no symmetry."""
    leg = trimesh.creation.box((0.03, 0.05, 0.08))
    leg.apply_translation((0.05, 0.02, 0.06))
    return trimesh.creation.box((0.16, 0.10, 0.06)) + leg


@pytest.fixture(scope="module")
def library(mesh: trimesh.Trimesh) -> ObjectLibrary:
    """Its voxels."""
    return library_of_mesh(mesh.vertices, mesh.faces, 0.002)


def ratios(library: ObjectLibrary, evidence: DepthEvidence, hypotheses: PosedObjects) -> NDArray[np.float64]:
    """Log likelihood ratios (N,) of at most `COMPARED` hypotheses: one kernel serves them all."""
    filled = jax.tree.map(lambda leaf: np.resize(leaf, (COMPARED, *leaf.shape[1:])), hypotheses)
    return np.asarray(log_likelihood_ratio(library, NOISE, evidence, filled), np.float64)[: len(hypotheses)]


def reference_log_likelihood(
    noise: DepthNoise, observed: NDArray[np.floating], rendered: NDArray[np.floating]
) -> float:
    """The sum over pixels of docs/model.md, section 0, in float64."""
    observed, rendered = observed.astype(np.float64), rendered.astype(np.float64)
    observed = np.where(np.isfinite(observed) & (observed > 0), observed, 0.0)
    sigma = noise.sigma_base_m + noise.sigma_growth_per_m * (rendered - 0.4) ** 2
    uniform = (observed <= noise.max_range_m) / noise.max_range_m
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = stats.norm.pdf(observed, rendered, sigma)
        inlier = (1 - noise.outlier_probability) * normal
        hit = (1 - noise.none_hit_probability) * (noise.outlier_probability * uniform + inlier)
    hit = np.where(observed == 0, noise.none_hit_probability, hit)
    miss = np.where(observed == 0, noise.none_miss_probability, (1 - noise.none_miss_probability) * uniform)
    return float(np.log(np.where(np.isfinite(rendered), hit, miss)).sum())


def scene(rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A noisy observed image and a rest: a wall on the left, nothing on the right, something in front."""
    rest = np.full((HEIGHT, WIDTH), np.inf, np.float32)
    rest[:, :70] = 0.9
    rest[60:, 30:50] = 0.3
    observed = np.where(np.isfinite(rest), rest, 0.0) + rng.normal(0, 0.003, rest.shape)
    observed[rng.random(rest.shape) < 0.1] = 0.0
    observed[:5] = np.nan
    observed[5:7] = -1.0
    observed[7:9] = np.inf
    return observed.astype(np.float32), rest


def test_differences_agree_with_float64(library: ObjectLibrary, mesh: trimesh.Trimesh, seed: int) -> None:
    """Log likelihoods of 60 hypotheses differ among each other as in float64, to 0.1 nat."""
    rng = np.random.default_rng(seed)
    observed, rest = scene(rng)
    poses = random_views(rng, mesh, COMPARED)
    poses[1:30] = poses[0]
    poses[1:30, :3, 3] += rng.normal(0, 0.01, (29, 3))
    layers = np.asarray(render_layers(library, posed(poses), cameras(), HEIGHT, WIDTH))
    observed = np.where(layers[0] < rest, layers[0] + rng.normal(0, 0.002, rest.shape), observed)
    expected = [reference_log_likelihood(NOISE, observed, np.minimum(layer, rest)) for layer in layers]

    evidence = depth_evidence(
        NOISE, cameras(), jnp.asarray(observed, jnp.float32)[None], jnp.asarray(rest)[None]
    )
    actual = ratios(library, evidence, posed(poses))

    error = actual - np.array(expected)
    assert np.isfinite(actual).all()
    assert np.ptp(error) < 0.1, f"differences are off by up to {np.ptp(error):.3f} nat"


def test_an_unseen_object_leaves_the_rest(library: ObjectLibrary, seed: int) -> None:
    """Behind the camera, or hidden behind a wall: as likely as the image without it."""
    observed, rest = scene(np.random.default_rng(seed))
    rest = np.full_like(rest, 0.4)
    evidence = depth_evidence(NOISE, cameras(), jnp.asarray(observed)[None], jnp.asarray(rest)[None])
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, 2, 3] = [-1.0, 1.0]

    actual = ratios(library, evidence, posed(poses))

    np.testing.assert_array_equal(actual, 0.0)


def test_each_hypothesis_is_held_against_its_own_image(library: ObjectLibrary, seed: int) -> None:
    """Several images in one call give what each gives alone."""
    rng = np.random.default_rng(seed)
    pairs = [scene(rng) for _ in range(3)]
    observed, rest = (jnp.asarray(np.stack(images)) for images in zip(*pairs, strict=True))
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = [0.5, 0.6, 0.7]
    three = jax.tree.map(lambda leaf: jnp.repeat(leaf, 3), cameras())
    hypotheses = replace(posed(poses), camera_index=jnp.arange(3, dtype=jnp.int32))

    together = ratios(library, depth_evidence(NOISE, three, observed, rest), hypotheses)

    for index in range(3):
        single = depth_evidence(NOISE, cameras(), observed[index][None], rest[index][None])
        alone = ratios(library, single, posed(poses[index : index + 1]))
        np.testing.assert_allclose(together[index], alone[0], rtol=1e-6)


def test_one_trace_serves_all_poses_and_objects_of_a_bucket(library: ObjectLibrary, seed: int) -> None:
    """Other poses, another object, another lens and another image of the same sizes compile nothing anew."""
    rng = np.random.default_rng(seed)
    observed, rest = (jnp.asarray(image)[None] for image in scene(rng))
    both = join([library, library])
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 2, 3] = [0.4, 0.6, 0.8, 2.0]

    def score(index: int, focal: float) -> None:
        lens = jax.tree.map(lambda leaf: leaf * focal, cameras())
        log_likelihood_ratio(both, NOISE, depth_evidence(NOISE, lens, observed, rest), posed(poses, index))

    score(0, 1.0)
    traced = gain_over_rest._jitted._cache_size()  # pyright: ignore[reportAttributeAccessIssue]
    score(1, 1.3)

    assert gain_over_rest._jitted._cache_size() == traced  # pyright: ignore[reportAttributeAccessIssue]
