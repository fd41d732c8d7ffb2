"""Terms of two keyframes' overlap against autodiff in float64; all but the gaps is taken as fixed."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from recordings.types import DepthNoise
from shapes.geometry import pose_gaussian
from shapes.geometry.poses import single_precision_poses
from slam.keyframes.depth_view import FINE_CANVAS, view_of_frame
from slam.keyframes.planes import region_planes
from slam.likelihood.overlap_density import (
    LOG_OUTLIER,
    OUTLIER_SHARE,
    PlaneImage,
    PointSample,
    overlap_terms,
    points_at,
    sampled_pixels,
)
from slam.pose_graph.linearisation import told_projections
from tests.slam import box_room

NOISE = DepthNoise()
SURFACE, IMAGE = box_room.pose(0.0, 0.0, -0.5), box_room.pose(0.15, 0.04, -0.45, 0.12, 0.05)
OFF = np.asarray([0.003, -0.002, 0.002, 0.001, -0.002, 0.0015])
LEAST_COSINES = (0.87, 0.2)
"""Between normals, and between rays and normals, from which on a pixel counts."""


def _keyframe(pose: np.ndarray, seed: int) -> tuple[PlaneImage, PointSample]:
    view = view_of_frame(box_room.frames(pose[None], seed=seed)[0], box_room.INTRINSICS, FINE_CANVAS)
    planes, sizes = region_planes(view, NOISE)
    planes = jnp.where((sizes > 0)[None], planes, 0.0)
    return PlaneImage.of(view, planes), points_at(view, planes, sampled_pixels(np.asarray(sizes)))


def _sigma(depth: np.ndarray) -> np.ndarray:
    return NOISE.sigma_base_m + NOISE.sigma_growth_per_m * (depth - 0.4) ** 2


def _met(surface: PlaneImage, sample: PointSample, relative: np.ndarray) -> tuple[np.ndarray, ...]:
    """Points (n, 3) of the sample, planes (n, 3) they fall on, and variances (n,) of their gaps."""
    points = np.asarray(sample.points, np.float64).T
    normals = np.asarray(sample.normals, np.float64).T
    planes, rays, depths = np.split(np.asarray(surface.elements, np.float64).reshape(-1, 7), (3, 6), axis=1)
    there = points @ relative[:3, :3].T + relative[:3, 3]
    intrinsics, (rows, columns) = box_room.INTRINSICS, box_room.depth_image(SURFACE).shape
    ahead = np.where(there[:, 2] > 0.05, there[:, 2], np.inf)
    u = np.rint(intrinsics.fx * there[:, 0] / ahead + intrinsics.cx).astype(int)
    v = np.rint(intrinsics.fy * there[:, 1] / ahead + intrinsics.cy).astype(int)
    inside = (points[:, 2] > 0) & np.isfinite(ahead) & (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
    pixel = np.where(inside, v * FINE_CANVAS[1] + u, 0)
    plane, length = planes[pixel], np.linalg.norm(planes[pixel], axis=1)
    inside &= length > 0
    unit = plane / np.where(length > 0, length, 1.0)[:, None]
    depth, surface_depth = points[:, 2], depths[pixel, 0]
    ray = (points / np.where(depth > 0, depth, 1.0)[:, None]) @ relative[:3, :3].T
    surface_ray = rays[pixel]
    along, surface_along = (unit * ray).sum(1), (unit * surface_ray).sum(1)
    inside &= (unit * (normals @ relative[:3, :3].T)).sum(1) > LEAST_COSINES[0]
    inside &= along > LEAST_COSINES[1] * np.linalg.norm(ray, axis=1)
    inside &= surface_along > LEAST_COSINES[1] * np.linalg.norm(surface_ray, axis=1)
    variance = (_sigma(depth) * along) ** 2 + (_sigma(surface_depth) * surface_along) ** 2
    return points[inside], plane[inside], variance[inside]


def test_terms_of_an_overlap_are_those_of_autodiff():
    """Gradient of minus the log density and weighed curvature, in both keyframes' displacements."""
    surface, _ = _keyframe(SURFACE, 1)
    _, sample = _keyframe(IMAGE, 2)
    off = pose_gaussian.displace(
        single_precision_poses((np.linalg.inv(SURFACE) @ IMAGE)[None])[0], jnp.asarray(OFF, jnp.float32)
    )

    terms = overlap_terms(surface, jax.tree.map(lambda leaf: leaf[None], sample), off[None], NOISE, 1.0)

    with jax.enable_x64(True):
        relative = jaxlie.SE3(jnp.asarray(np.asarray(off), jnp.float64))
        points, planes, variance = map(jnp.asarray, _met(surface, sample, np.asarray(relative.as_matrix())))

        def gaps(xi: jax.Array) -> jax.Array:
            of_surface = jaxlie.SE3(pose_gaussian.displace(jaxlie.SE3.identity().wxyz_xyz, xi[6:]))
            moved = jaxlie.SE3(pose_gaussian.displace(relative.wxyz_xyz, xi[:6]))
            there = jax.vmap((of_surface.inverse() @ moved).apply)(points)
            return ((there * planes).sum(1) - 1.0) / jnp.linalg.norm(planes, axis=1)

        def log_surface(xi: jax.Array) -> jax.Array:
            normalised = gaps(xi) ** 2 / variance + jnp.log(2 * jnp.pi * variance)
            return jnp.log(1.0 - OUTLIER_SHARE) - 0.5 * normalised

        zero = jnp.zeros(12, jnp.float64)
        gradient = jax.jit(jax.grad(lambda xi: -jnp.logaddexp(log_surface(xi), LOG_OUTLIER).sum()))(zero)
        jacobian = jax.jit(jax.jacfwd(gaps))(zero)
        inlier = jax.nn.sigmoid(log_surface(zero) - LOG_OUTLIER)
        precision = (jacobian * (inlier / variance)[:, None]).T @ jacobian
        inlier, precision, gradient = map(np.asarray, (inlier, precision, gradient))

    assert len(points) > 1000
    scale = np.sqrt(np.diagonal(precision))
    np.testing.assert_allclose(terms.inliers[0], inlier.sum(), rtol=0.005)
    np.testing.assert_allclose(
        terms.precision[0] / np.outer(scale, scale), precision / np.outer(scale, scale), atol=0.01
    )
    np.testing.assert_allclose(
        terms.gradient[0] / scale, gradient / scale, atol=0.02 * np.abs(gradient / scale).max()
    )


WALL_M, SLOPE_SD = 2.0, 0.05
"""A bare wall square to the camera, and noise of its inverse depth's slopes, in units of the depth."""


def test_noise_of_normals_is_no_information_along_a_bare_wall():
    """Gauss-Newton takes it for some, the two keyframes' normals together do not, nor what is told of it.

    Of n pixels the sum of products of independent slopes has a standard deviation of n^-1/2 of that of
    squares: 5 of them bound it, and their square what is told. Across the wall nothing changes.
    """
    rng = np.random.default_rng(8)
    depth = np.full(box_room.depth_image(SURFACE).shape, WALL_M, np.float32)
    frame = replace(box_room.frames(SURFACE[None], seed=1)[0], depth_m=depth)
    view = view_of_frame(frame, box_room.INTRINSICS, FINE_CANVAS)

    def noisy_planes() -> jax.Array:
        slopes = SLOPE_SD / WALL_M * rng.normal(size=(2, *view.depth_m.shape))
        offset = 1.0 / WALL_M - slopes[0] * view.rays[0] - slopes[1] * view.rays[1]
        return jnp.asarray(np.stack([*slopes, offset]), jnp.float32)

    sample = points_at(view, noisy_planes(), sampled_pixels(np.full(view.depth_m.shape, 1e4)))
    here = single_precision_poses(np.eye(4)[None])
    samples = jax.tree.map(lambda leaf: leaf[None], sample)
    terms = overlap_terms(PlaneImage.of(view, noisy_planes()), samples, here, NOISE, 1.0)

    precision, information = (np.asarray(leaf, np.float64) for leaf in (terms.precision, terms.information))
    bound = 5.0 / np.sqrt(float(terms.inliers[0]))
    projection = told_projections(precision, information)
    told = projection @ precision @ projection.swapaxes(1, 2)
    assert bound < 0.2
    for along in (0, 1):
        assert precision[0, along, along] > 0.5 * SLOPE_SD**2 * precision[0, 2, 2]
        assert abs(information[0, along, along]) < bound * precision[0, along, along]
        assert told[0, along, along] < bound**2 * precision[0, along, along]
    np.testing.assert_allclose(told[0, 2, 2], precision[0, 2, 2], rtol=0.02)
