"""Robust Gauss-Newton: the local optimum of the image density, and its curvature."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie

from recordings.types import NO_RETURN, DepthNoise
from shapes import depth_noise
from shapes.geometry import pose_gaussian
from shapes.geometry.camera import Camera
from shapes.geometry.poses import transformed
from shapes.geometry.vectors import cross, dot, rotate
from slam.keyframes.depth_view import CanvasView
from slam.keyframes.rendering import LEAST_INVERSE_DEPTH, depth_from, pixels_of
from slam.likelihood.image_density import LOG_ROOT_TWO_PI, STRIDE_PX

STIFFNESS = 10.0
"""Precision in 1/m^2 and 1/rad^2 that holds a start in directions which no pixel sees."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ModelImage:
    """The map fused into one surface element per pixel of one camera.

    Attributes:
        planes: (3, H, W) plane vectors in that camera's frame, zeros where the map shows nothing.
        variance_m2: (H, W) variance of the rendered depth.
        camera: intrinsics of the camera.
    """

    planes: jax.Array
    variance_m2: jax.Array
    camera: Camera


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class InlierCounts:
    """How well a frame agrees with the map at a pose.

    Attributes:
        explained: share of the returns that lie on the map's surface.
        covered: share of the returns whose ray meets the map.
    """

    explained: jax.Array
    covered: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PixelTerms:
    """Gauss-Newton terms of the log factors of n pixels, in the chart at the pose they were taken at.

    Attributes:
        jacobian: (6, n) of the rendered depth.
        weight: (n,) inverse variance times `inlier`.
        inlier: (n,) probability that the pixel is neither an outlier nor without a surface.
        residual: (n,) observed minus rendered depth, metres.
        agreement: over these pixels.
    """

    jacobian: jax.Array
    weight: jax.Array
    inlier: jax.Array
    residual: jax.Array
    agreement: InlierCounts

    def scores(self) -> jax.Array:
        """Gradients (6, n) of the log factors."""
        return self.jacobian * (self.weight * self.residual)[None]

    def precision(self) -> jax.Array:
        """Gauss-Newton curvature (6, 6) of minus the log density."""
        return (self.jacobian * self.weight[None]) @ self.jacobian.T

    def held_step(self, offset: jax.Array, hold: jax.Array | float) -> jax.Array:
        """The Newton step (6,) that is held at the start, from `offset` (6,) away from it.

        Along a bare wall the noise of the elements' normals passes for information, some hundredth of
        that across the wall, and steps would wander off. `hold`, a share of the mean precision of
        translations, leaves motion along it to the start, which must then be a prediction worth
        keeping (compare the degenerate directions of Zhang, Kaess and Singh 2016).
        """
        precision = self.precision()
        across = jnp.trace(precision[:3, :3]) / 3.0
        held = STIFFNESS + hold * across * jnp.asarray([1, 1, 1, 0, 0, 0], precision.dtype)
        return jnp.linalg.solve(precision + jnp.diag(held), self.scores().sum(1) - held * offset)


@dataclass(frozen=True)
class Passes:
    """Gauss-Newton iterations on every `stride_px`-th pixel, sigma times each of `inflations` in turn."""

    stride_px: int
    inflations: tuple[float, ...]


def depth_and_jacobian(planes: jax.Array, rays: jax.Array, pose: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Depth (n,) of planes (3, n) on a camera's rays (3, n) and its derivative (6, n) in the pose.

    Depth is (1 - N . t) / (N . R d), +inf where the plane is not ahead; the derivative is in the chart
    of `pose_gaussian` at `pose` (7,), planes_from_camera.
    """
    planes_from_camera = jaxlie.SE3(pose)
    normals = rotate(planes_from_camera.rotation().as_matrix().T, planes)
    height = 1.0 - dot(planes_from_camera.translation(), planes)
    slope = dot(normals, rays)
    ahead = (height > 0) & (slope > LEAST_INVERSE_DEPTH * height)
    safe_slope = jnp.where(ahead, slope, 1.0)
    depth = jnp.where(ahead, height / safe_slope, 0.0)
    jacobian = jnp.concatenate([-normals, -depth[None] * cross(rays, normals)]) / safe_slope[None]
    return jnp.where(ahead, depth, jnp.inf), jnp.where(ahead[None], jacobian, 0.0)


def pixel_terms(
    planes: jax.Array,
    variance_m2: jax.Array,
    observed_m: jax.Array,
    rays: jax.Array,
    pose: jax.Array,
    noise: DepthNoise,
    inflation: jax.Array | float = 1.0,
) -> PixelTerms:
    """Terms of pixels (n,) that see planes (3, n) of depth variance (n,) from planes_from_camera (7,).

    Each pixel's Normal is weighed by the probability that it is not an outlier (the E-step of its
    mixture), which makes the gradient that of the density itself.
    """
    depth, jacobian = depth_and_jacobian(planes, rays, pose)
    returned = observed_m > NO_RETURN
    hit = returned & jnp.isfinite(depth)
    depth = jnp.where(hit, depth, 1.0)
    variance = inflation**2 * (depth_noise.standard_deviation(noise, depth) ** 2 + variance_m2)
    residual = jnp.where(hit, observed_m - depth, 0.0)
    log_ratio = (
        jnp.log1p(-noise.outlier_probability)
        - jnp.log(noise.outlier_probability / noise.max_range_m)
        - 0.5 * (residual**2 / variance + jnp.log(2.0 * jnp.pi * variance))
    )
    inlier = jnp.where(hit, jax.nn.sigmoid(log_ratio), 0.0)
    count = jnp.maximum(returned.sum(), 1)
    return PixelTerms(
        jacobian, inlier / variance, inlier, residual, InlierCounts(inlier.sum() / count, hit.sum() / count)
    )


def associate(model: ModelImage, view: CanvasView, pose: jax.Array, stride_px: int) -> tuple[jax.Array, ...]:
    """Planes and variances of the model pixels that the view's points fall into, with depths and rays."""
    observed, rays = view.lattice(stride_px)
    pixel, inside = pixels_of(transformed(pose, rays * observed[None]), model.camera)
    planes = jnp.where(inside[None], model.planes.reshape(3, -1)[:, pixel], 0.0)
    return planes, model.variance_m2.ravel()[pixel], observed, rays


def projected_scores(
    model: ModelImage,
    view: CanvasView,
    log_unknown_shortfall: jax.Array,
    noise: DepthNoise,
    poses: jax.Array,
    stride_px: int,
    surface_sigma_m: float,
) -> jax.Array:
    """Scores (C,) of every `stride_px`-th pixel of a view at candidates model_from_camera (C, 7).

    The reverse projection: a pixel is compared with the element that its own observed point falls on.
    Its log factor is the larger one of the surface's Normal, blurred by `surface_sigma_m` so that a
    coarse grid of candidates cannot step over a mode, and of an outlier; or, beside the rendering, that of an
    unknown surface (on the lattice of the image density), without which candidates that fall on more of it
    would win along a bare wall. It ranks candidates near one rendering; what is found is weighed by the image
    density.
    """
    observed, rays = view.lattice(stride_px)
    points = rays * observed[None]
    log_outlier = jnp.log(noise.outlier_probability / noise.max_range_m)
    every = stride_px // STRIDE_PX
    shortfall = log_unknown_shortfall[::every, ::every].ravel()
    blurred = jnp.hypot(surface_sigma_m, depth_noise.standard_deviation(noise, observed))
    log_miss = shortfall - jnp.log(blurred) - LOG_ROOT_TWO_PI
    elements = jnp.concatenate([model.planes.reshape(3, -1), model.variance_m2.reshape(1, -1)]).T

    def score(pose: jax.Array) -> jax.Array:
        pixel, inside = pixels_of(transformed(pose, points), model.camera)
        element = elements[pixel].T
        depth, _, ahead = depth_from(pose, element[:3], rays)
        variance = element[3] + surface_sigma_m**2 + depth_noise.standard_deviation(noise, depth) ** 2
        log_normal = -0.5 * ((observed - depth) ** 2 / variance + jnp.log(2.0 * jnp.pi * variance))
        log_factor = jnp.where(inside & ahead, jnp.maximum(log_normal, log_outlier), log_miss)
        return jnp.where(observed > NO_RETURN, log_factor, 0.0).sum()

    return jax.vmap(score)(poses)


def align(
    model: ModelImage,
    view: CanvasView,
    noise: DepthNoise,
    start: jax.Array,
    hold: jax.Array | float,
    schedule: tuple[Passes, ...],
) -> jax.Array:
    """Local optimum (7,) of the view's density over model_from_camera, from `start` (7,).

    A point's surface element is the one it projects to, anew in each pass, so starts may be some
    hundredth of the field of view away; it is held at the start as in `PixelTerms.held_step`.
    """

    def iteration(pose: jax.Array, inflation: jax.Array, stride_px: int) -> tuple[jax.Array, None]:
        planes, variance, observed, rays = associate(model, view, pose, stride_px)
        terms = pixel_terms(planes, variance, observed, rays, pose, noise, inflation)
        step = terms.held_step(pose_gaussian.coordinates(start, pose), hold)
        return pose_gaussian.displace(pose, step), None

    pose = start
    for passes in schedule:
        inflations = jnp.asarray(passes.inflations, start.dtype)
        pose, _ = jax.lax.scan(partial(iteration, stride_px=passes.stride_px), pose, inflations)
    return pose
