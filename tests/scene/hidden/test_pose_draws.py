"""Draws through unexplained points, and those that a rough look spares, against plain draws of the prior."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from recordings.types import DepthNoise
from scene.hidden.depth_evidence import DepthImages, SeenImage
from scene.hidden.hidden_objects import mean_ratio
from scene.hidden.point_proposals import PosesThroughPoints, Shell
from scene.hidden.pose_draws import PriorDraws, RouletteDraws, pose_draws
from scene.hidden.pose_kernels import PoseKernels
from scene.hidden.pose_priors import EulerUniformPoses
from scene.objects.scene_object import SceneObject, scene_object
from shapes.geometry.camera import Camera
from shapes.geometry.poses import motions_of

HEIGHT, WIDTH, FOCAL, FAR_M, SCREEN_M = 18, 24, 20.0, 2.0, 0.6
SIZE_M = 0.06, 0.04, 0.03

SHOWN = 9, 15
"""The pixel beside the screen in which something shows itself, row and column."""

NOISE = DepthNoise(
    sigma_base_m=0.01,
    sigma_growth_per_m=0.0,
    outlier_probability=0.1,
    none_hit_probability=0.0,
    none_miss_probability=0.0,
    max_range_m=FAR_M,
)
PRIOR = EulerUniformPoses(
    low_m=np.array([-0.14, -0.12, 0.45]),
    high_m=np.array([0.14, 0.12, 0.85]),
    world_from_cuboid=motions_of(np.array([0.02, 0.01, 0.0, 0.0, -0.05, 0.3])),
)


@pytest.fixture(scope="module")
def brick() -> SceneObject:
    """A small box."""
    mesh = trimesh.creation.box(SIZE_M)
    return scene_object("brick", mesh.vertices, mesh.faces)


@pytest.fixture(scope="module")
def images() -> DepthImages:
    """A screen before a far wall, and one pixel beside it that shows a point between them."""
    rest_m = np.full((HEIGHT, WIDTH), FAR_M, np.float32)
    rest_m[5:14, 9:15] = SCREEN_M
    observed_m = rest_m.copy()
    observed_m[SHOWN] = 0.7
    camera = Camera(*(jnp.float32(value) for value in (FOCAL, FOCAL, 11.5, 8.5)))
    seen = SeenImage(camera=camera, camera_from_world=np.eye(4), observed_m=observed_m, rest_m=rest_m[None])
    return DepthImages([seen], NOISE)


def test_the_point_that_nothing_explains(images: DepthImages) -> None:
    """The pixel's, on its ray."""
    row, column = SHOWN
    expected = 0.7 * np.array([(column - 11.5) / FOCAL, (row - 8.5) / FOCAL, 1.0])

    np.testing.assert_allclose(images.unexplained_points_m(), expected[None], atol=1e-6)


def test_the_shell_holds_the_surface_and_little_else(brick: SceneObject, seed: int) -> None:
    """All points of the faces but at most one in a thousand; no more than a layer about them."""
    shell = Shell.of(brick)
    surface_m = np.asarray(trimesh.creation.box(SIZE_M).sample(4000, seed=seed), float)

    assert shell.holds(surface_m).mean() > 0.999
    assert shell.holds(shell.draw(np.random.default_rng(seed), 1000)).all()
    assert not shell.holds(np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]])).any()


@pytest.mark.parametrize("rounds", [0, 1, 2])
def test_weights_turn_the_mixture_into_the_prior(brick: SceneObject, seed: int, rounds: int) -> None:
    """The mean weight is one, and weighted means of the pose are the prior's: each missed once in 16,000.

    Before the mixture is fitted, and after, with kernels: to weights that prefer some poses.
    """
    rng = np.random.default_rng(seed)
    points_m = np.array([[0.05, 0.0, 0.6], [0.05, 0.04, 0.62], [-0.2, 0.0, 0.7]])
    proposal = PosesThroughPoints.even(brick, PRIOR, points_m)
    assert proposal is not None
    for _ in range(rounds):
        poses = proposal.draw(rng, brick, 512)
        proposal = proposal.fitted(rng, poses, proposal.log_weights(poses) + 40 * poses[:, 0, 3])
    assert (proposal.kernels is not None) == (rounds > 0)

    poses = proposal.draw(rng, brick, 2**16)
    weights = np.exp(proposal.log_weights(poses))

    plain = PRIOR.draw(rng, [brick], 2**16)[0]
    told = np.concatenate([np.ones((2**16, 1)), poses[:, :3, 3], poses[:, 2, :3] ** 2], axis=1)
    expected = np.concatenate([np.ones((2**16, 1)), plain[:, :3, 3], plain[:, 2, :3] ** 2], axis=1)
    told *= weights[:, None]
    error = np.sqrt((told.var(axis=0) + expected.var(axis=0)) / 2**16)
    assert (np.abs(told.mean(axis=0) - expected.mean(axis=0)) < 4 * error + 1e-12).all()


def test_the_density_of_kernels_is_that_of_their_draws(seed: int) -> None:
    """Against a wider mixture: importance weights have mean one, missed once in 16,000."""
    rng = np.random.default_rng(seed)
    centres = motions_of(rng.normal(size=(6, 6)) * np.repeat([0.01, 0.2], 3))
    kernels = PoseKernels(centres=centres[:3])
    wider = PoseKernels(centres=centres)

    poses = wider.draw(rng, 2**15)
    weights = np.exp(kernels.log_density(poses) - wider.log_density(poses))

    assert abs(weights.mean() - 1) < 4 * weights.std() / np.sqrt(2**15)


def test_points_out_of_reach_are_left_out(brick: SceneObject) -> None:
    """None is left of those a metre away."""
    assert PosesThroughPoints.even(brick, PRIOR, np.array([[0.0, 0.0, 2.0]])) is None


def test_the_mean_ratio_is_that_of_plain_draws(brick: SceneObject, images: DepthImages, seed: int) -> None:
    """Against all prior poses rendered: four standard errors, of which the point's share is many."""
    plain = PriorDraws(objects=[brick], prior=PRIOR, images=images)
    batches = [plain.draw(np.random.default_rng([seed, at]), 2**14)[1] for at in range(4)]
    ratios = np.exp(np.concatenate(batches))

    found = mean_ratio(np.random.default_rng(seed), [brick], PRIOR, images, draws=2**17, keep=256)

    error = np.hypot(ratios.std() / np.sqrt(len(ratios)), found.standard_error)
    assert ratios[ratios > 2].sum() / len(ratios) > 4 * error
    assert abs(found.mean - ratios.mean()) < 4 * error


def test_fitted_draws_find_the_point(brick: SceneObject, images: DepthImages, seed: int) -> None:
    """Poses that the image speaks for are drawn ten times as often as from the prior, or more."""
    plain = PriorDraws(objects=[brick], prior=PRIOR, images=images)
    through = pose_draws(np.random.default_rng(seed), [brick], PRIOR, images, 2**14)

    count = 2**14
    seldom = (plain.draw(np.random.default_rng(seed), count)[1] > 2).sum()
    poses, _ = through.draw(np.random.default_rng(seed), count)
    often = (images.log_ratios(brick, poses[0]) > 2).sum()

    assert often > 10 * max(seldom, 1)


def test_roulette_keeps_the_mean(brick: SceneObject, images: DepthImages, seed: int) -> None:
    """The same poses, all rendered, and by chance as the rough look says: four standard errors."""
    draws = RouletteDraws(one=brick, prior=PRIOR, images=images)
    poses, log_weights = draws.draw(np.random.default_rng(seed), 2**16)
    ratios = images.log_ratios(brick, PRIOR.draw(np.random.default_rng(seed + 1), [brick], 2**14)[0])

    kept = np.zeros(2**16)
    kept[: len(log_weights)] = np.exp(log_weights)
    assert poses.shape == (1, len(log_weights), 4, 4)
    assert len(log_weights) < 0.8 * 2**16
    error = np.hypot(kept.std() / 2**8, np.exp(ratios).std() / 2**7)
    assert abs(kept.mean() - np.exp(ratios).mean()) < 4 * error
