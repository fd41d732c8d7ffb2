"""The point-cloud density against a KD-tree in float64."""

import jax.numpy as jnp
import numpy as np
import trimesh
from scipy.spatial import KDTree

from scene.likelihood.point_clouds import CloudNoise, log_density, window_half_width
from scene.observation.depth_view import unproject
from shapes.rendering.depth_rendering import render_layers
from shapes.rendering.object_library import library_of_mesh
from tests.shapes.views import INTRINSICS, cameras, posed, random_views

HEIGHT, WIDTH = INTRINSICS.height, INTRINSICS.width
RADIUS_M = 0.004
NOISE = CloudNoise(outlier_probability=0.05, outlier_volume_m3=0.5, radius_m=RADIUS_M)


def reference(points_m: np.ndarray, rendered_m: np.ndarray) -> float:
    """Main paper, section 3.3, by counting in a tree."""
    camera = cameras()
    one = type(camera)(*(jnp.asarray(leaf[0], jnp.float32) for leaf in vars(camera).values()))
    cloud = unproject(rendered_m.astype(np.float32), one)
    cloud = cloud[np.isfinite(rendered_m)]
    if not len(cloud):
        return len(points_m) * float(np.log(1 / NOISE.outlier_volume_m3))
    counts = KDTree(cloud).query_ball_point(points_m, NOISE.radius_m, return_length=True)
    ball = 4 / 3 * np.pi * NOISE.radius_m**3
    inlier = (1 - NOISE.outlier_probability) * counts / (len(cloud) * ball)
    return float(np.log(NOISE.outlier_probability / NOISE.outlier_volume_m3 + inlier).sum())


def test_differences_agree_with_a_tree(seed: int) -> None:
    """Log likelihoods of hypotheses differ among each other as those of a KD-tree in float64, to 0.1 nat.

    The points keep clear of the sphere's border by a hundredth of the radius or so, where float32 may count
    otherwise: counts that differ by one at K = 60 neighbours would be 0.017 nat.
    """
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.box((0.16, 0.06, 0.21))
    library = library_of_mesh(mesh.vertices, mesh.faces)
    poses = random_views(rng, mesh, 9)[::3].repeat(4, axis=0)
    poses[1:, :3, 3] += rng.normal(0, 0.002, (len(poses) - 1, 3))
    rest = np.full((HEIGHT, WIDTH), np.inf, np.float32)
    rest[:, :40] = 1.2
    layers = np.asarray(render_layers(library, posed(poses), cameras(), HEIGHT, WIDTH))
    camera = cameras()
    one = type(camera)(*(jnp.asarray(leaf[0], jnp.float32) for leaf in vars(camera).values()))
    seen = unproject(layers[0], one)[np.isfinite(layers[0])]
    points = seen[rng.choice(len(seen), 200)] + rng.normal(0, 0.001, (200, 3))
    half_image = max(WIDTH, HEIGHT)
    half_width = window_half_width(RADIUS_M, float(points[:, 2].min()), 145.0, half_image)

    actual = [
        log_density(NOISE, one, jnp.asarray(points, jnp.float32), jnp.minimum(layer, rest), half_width)
        for layer in layers
    ]

    expected = [reference(points, np.minimum(layer, rest)) for layer in layers]
    error = np.asarray(actual, np.float64) - expected
    assert np.ptp(expected) > 10
    assert np.ptp(error) < 0.1


def test_an_empty_rendering_is_a_density() -> None:
    """Nothing rendered: every point is an outlier, 1 / B each; padding counts for nothing."""
    camera = cameras()
    one = type(camera)(*(jnp.asarray(leaf[0], jnp.float32) for leaf in vars(camera).values()))
    points = jnp.array([[0.0, 0.0, 0.5], [0.1, 0.0, 0.6], [0.0, 0.0, 0.0]], jnp.float32)

    density = log_density(NOISE, one, points, jnp.full((HEIGHT, WIDTH), jnp.inf, jnp.float32), 3)

    np.testing.assert_allclose(float(density), 2 * np.log(1 / NOISE.outlier_volume_m3), rtol=1e-6)
