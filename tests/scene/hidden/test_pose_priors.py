"""Priors of hidden objects' poses."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from pipeline.benchmarks.seen_object import seen_posterior
from scene.hidden.pose_priors import EulerUniformPoses, PlacedObject, RestingPoses, Support
from scene.objects.scene_object import SceneObject, scene_object
from tests.statistical import assert_mean, assert_uniform

PRIOR = EulerUniformPoses(low_m=np.array([-0.2, 0.0, 0.5]), high_m=np.array([0.2, 0.1, 0.9]))


@lru_cache(maxsize=1)
def cube() -> SceneObject:
    """Of unit size."""
    mesh = trimesh.creation.box((1, 1, 1))
    return scene_object("cube", mesh.vertices, mesh.faces)


def box(name: str, size_m: tuple[float, float, float]) -> SceneObject:
    """A box of this size, but for its distance field, which no prior looks at."""
    one, size = cube(), np.array(size_m)
    points_m = (one.points_m * size).astype(np.float32)
    return replace(one, name=name, points_m=points_m, half_extents_m=size / 2)


def test_euler_angles_are_uniform(seed: int) -> None:
    """The middle angle too, unlike under the Haar measure."""
    poses = PRIOR.draw(np.random.default_rng(seed), [box("one", (0.1, 0.1, 0.1))], 4000)[0]
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX")

    assert_uniform(angles[:, 1], low=-np.pi / 2, high=np.pi / 2)
    assert_uniform(angles[:, 0], low=-np.pi, high=np.pi)
    assert_uniform(poses[:, 2, 3], low=0.5, high=0.9)


def test_their_density_integrates_to_one(seed: int) -> None:
    """Over the Haar measure of mass pi^2: mean density at uniform rotations, where cos beta is not near 0."""
    poses = np.tile(np.eye(4), (200_000, 1, 1))
    poses[:, :3, :3] = Rotation.random(len(poses), rng=np.random.default_rng(seed)).as_matrix()
    poses[:, :3, 3] = 0.0, 0.05, 0.6
    cosine = np.hypot(poses[:, 0, 0], poses[:, 1, 0])
    volume = 0.4 * 0.1 * 0.4
    held = np.exp(PRIOR.log_density(poses)) * np.pi**2 * volume * (cosine > 0.1)

    assert_mean(held, 2 / np.pi * np.arccos(0.1), detectable=0.02)


def test_a_volume_of_nothing_is_refused() -> None:
    """The message says which."""
    with pytest.raises(ValueError, match="the volume from 0,0,0 to 1,0,1 m holds nothing"):
        EulerUniformPoses(low_m=np.zeros(3), high_m=np.array([1.0, 0.0, 1.0]))


def test_objects_at_rest_stand_on_their_supports_clear_of_others(seed: int) -> None:
    """On both supports by their areas, none through a screen, none through each other."""
    shelf = np.eye(4)
    shelf[2, 3] = 0.5
    half = np.array([0.1, 0.1])
    supports = (
        Support(world_from_support=np.eye(4), half_size_m=half),
        Support(world_from_support=shelf, half_size_m=half),
    )
    screen = PlacedObject(shape=box("screen", (0.1, 0.1, 0.2)), world_from_box=np.eye(4))
    both = [box("one", (0.06, 0.06, 0.06)), box("other", (0.08, 0.08, 0.08))]

    poses = RestingPoses(supports=supports, others=(screen,)).draw(np.random.default_rng(seed), both, 1000)

    heights = poses[..., 2, 3] - np.array([0.03, 0.04])[:, None]
    on_shelf = heights > 0.25
    np.testing.assert_allclose(heights, np.where(on_shelf, 0.5, 0), atol=1e-6)
    assert on_shelf[0].mean() > 0.5  # the screen takes room below
    low = ~on_shelf[0]
    assert (np.linalg.norm(poses[0, low, :2, 3], axis=1) > 0.05 + 0.03 - 0.003).all()
    apart = np.linalg.norm(poses[0, :, :2, 3] - poses[1, :, :2, 3], axis=1)
    assert (apart[on_shelf[0] == on_shelf[1]] > 0.07 - 0.003).all()


def test_no_room_is_told() -> None:
    """Where a screen fills the support."""
    support = Support(world_from_support=np.eye(4), half_size_m=np.array([0.05, 0.05]))
    screen = PlacedObject(shape=box("screen", (0.3, 0.3, 0.3)), world_from_box=np.eye(4))

    with pytest.raises(ValueError, match="no room for one"):
        RestingPoses(supports=(support,), others=(screen,)).draw(
            np.random.default_rng(0), [box("one", (0.06, 0.06, 0.06))], 8
        )


class Quadratic:
    """In place of images: a Gaussian likelihood about a pose."""

    centre = np.eye(4)
    sigma_m, sigma_rad = 0.001, 0.004

    def __init__(self) -> None:
        self.centre = self.centre.copy()
        self.centre[:3, :3] = Rotation.from_euler("ZYX", [0.3, 0.8, -0.5]).as_matrix()
        self.centre[:3, 3] = 0.05, 0.04, 0.7

    def log_ratios(self, one: SceneObject, world_from_box: np.ndarray) -> np.ndarray:  # noqa: ARG002
        """Log likelihood (n,), 300 at its maximum."""
        places = (world_from_box[:, :3, 3] - self.centre[:3, 3]) / self.sigma_m
        turns = (
            Rotation.from_matrix(self.centre[:3, :3].T @ world_from_box[:, :3, :3]).as_rotvec()
            / self.sigma_rad
        )
        return 300 - 0.5 * (places**2).sum(axis=1) - 0.5 * (turns**2).sum(axis=1)


def test_the_evidence_of_an_object_in_sight(seed: int) -> None:
    """Against the integral of a Gaussian likelihood; the Haar measure's factor 8 and cos beta are in it."""
    images = Quadratic()
    start = images.centre.copy()
    start[0, 3] += 0.003

    found = seen_posterior(
        np.random.default_rng(seed), box("one", (0.1, 0.1, 0.1)), start, PRIOR, images, draws=4000, keep=1000
    )

    log_prior = np.log(2 / (np.pi**3 * np.cos(0.8)) / (0.4 * 0.1 * 0.4))
    log_volume = 3 * np.log(2 * np.pi) + 3 * np.log(images.sigma_m * images.sigma_rad) - np.log(8)
    assert abs(found.log_ratio - (300 + log_prior + log_volume)) < 0.1
    spreads_m = found.poses[:, :3, 3].std(axis=0)
    np.testing.assert_allclose(spreads_m, images.sigma_m, rtol=0.15)  # of 1,000: six standard errors


def test_an_object_at_the_cuboids_corner(seed: int) -> None:
    """Seven draws in eight lie outside: the evidence is that of the part inside, an eighth.

    Its logarithm spreads by 0.24 over seeds, of which four times that is allowed.
    """
    images = Quadratic()
    images.centre[:3, 3] = PRIOR.low_m

    found = seen_posterior(
        np.random.default_rng(seed), box("one", (0.1, 0.1, 0.1)), images.centre, PRIOR, images, draws=4000
    )

    log_prior = np.log(2 / (np.pi**3 * np.cos(0.8)) / (0.4 * 0.1 * 0.4))
    log_volume = 3 * np.log(2 * np.pi) + 3 * np.log(images.sigma_m * images.sigma_rad) - np.log(8)
    assert abs(found.log_ratio - (300 + log_prior + log_volume - np.log(8))) < 0.95
    assert (found.poses[:, :3, 3] >= PRIOR.low_m).all()
