"""How well two keyframes agree where they overlap, pixel by pixel of the one on the planes of the other.

A pixel's gap is the distance of its point from the plane of the pixel that it falls on. Its factor is the
mixture of a Normal, whose variance is that of both depths across the plane, and of a uniform for what the
other keyframe does not see: an occluded or moved surface, an edge, empty space. Where densities at several
poses are compared, the same pixels give a factor at each, so that poses which look away cannot win.

Both depths may be distorted by the sensor's static field (`slam.likelihood.distortion`): gaps are those of
corrected depths, and terms tell how they follow the field's nodes. Of a surface's plane the offset follows
the field at the pixel, its orientation does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import ArrayLike
from numpy.typing import NDArray

from recordings.distortion_field import NODE_ROWS
from recordings.types import NO_RETURN, DepthNoise
from shapes import depth_noise
from shapes.geometry.camera import Camera
from shapes.geometry.vectors import cross, dot, rotate, transform
from shapes.stored_kernels import jit_stored
from slam.keyframes.depth_view import CanvasView
from slam.keyframes.rendering import pixels_of
from slam.likelihood.distortion import NodeWeights, node_products
from slam.likelihood.score_variance import score_variance

SAMPLES = 4096
"""Size of compiled arrays: pixels compared per keyframe, a fifth of a canvas."""

BLOCKS_ACROSS = 8
"""Blocks by which the variance of the score is estimated: 64 are enough for a 6 x 6 matrix."""

BLOCKS = BLOCKS_ACROSS**2
"""In all."""

OUTLIER_SHARE = 0.03
"""Chosen by hand."""

OUTLIER_RANGE_M = 0.1
"""Range of the uniform outlier density. Chosen by hand."""

LEAST_NORMAL_COSINE = 0.87
"""Of the angle between the normals that both keyframes have for one point: 30 degrees."""

LEAST_INCIDENCE_COSINE = 0.2
"""Depth at more grazing rays is not trusted."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PlaneImage:
    """A keyframe as a surface.

    Attributes:
        elements: (H, W, 7) plane in its frame, zeros where there is none, then ray and depth: what a pixel is
            asked for lies together, and is gathered in less time.
        camera: intrinsics on the canvas.
        nodes: of the distortion field, there.
    """

    elements: jax.Array
    camera: Camera
    nodes: NodeWeights

    @classmethod
    def of(cls, view: CanvasView, planes: jax.Array) -> PlaneImage:
        """A view with planes (3, H, W)."""
        leaves = jnp.concatenate([planes, view.rays, view.depth_m[None]])
        return cls(jnp.moveaxis(leaves, 0, -1), view.camera, NodeWeights.of(view))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PointSample:
    """Points of a keyframe as an image, sorted into blocks of neighbours; zeros where there are fewer.

    Attributes:
        points: (3, SAMPLES) in its frame, metres.
        normals: (3, SAMPLES) unit, away from the camera.
        nodes: (NODE_ROWS + NODE_COLUMNS, SAMPLES) weights of the distortion field's nodes.
    """

    points: jax.Array
    normals: jax.Array
    nodes: jax.Array

    def node_weights(self) -> jax.Array:
        """(NODES, SAMPLES)."""
        return node_products(self.nodes[:NODE_ROWS], self.nodes[NODE_ROWS:])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FieldTerms:
    """How one overlap depends on the nodes of the distortion field.

    Attributes:
        precision: (NODES, NODES).
        gradient: (NODES,) of minus the log density.
        cross: (12, NODES) with the displacements of `OverlapTerms`.
    """

    precision: ArrayLike
    gradient: ArrayLike
    cross: ArrayLike


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OverlapTerms:
    """Gauss-Newton terms of one overlap, in displacements of the image's keyframe and of the surface's.

    Attributes:
        precision: (12, 12).
        gradient: (12,) of minus the log density.
        score_variance: (6, 6) of the gradient in the image's displacement, from blocks of pixels.
        information: (6, 6) in the image's displacement, the precision without what noise of normals adds to
            it: both keyframes have a normal for every pixel, and the errors of the two are independent.
        inliers: expected number of pixels on the surface.
        meeting: number of pixels that meet it.
        field: the same in the nodes of the distortion field, where it was given.
    """

    precision: jax.Array
    gradient: jax.Array
    score_variance: jax.Array
    information: jax.Array
    inliers: jax.Array
    meeting: jax.Array
    field: FieldTerms | None


def sampled_pixels(region_sizes: NDArray[np.floating]) -> NDArray[np.int32]:
    """Up to `SAMPLES` flat indices of pixels on planes, fewer on large regions (H, W); block by block.

    A table top says the same thing many times; what stands on it is seen by few pixels. Systematic: pixels
    in the order of the image at equal steps of their weights' running sum.
    """
    sizes = region_sizes.astype(np.float64)
    weight = (sizes > 0) / np.sqrt(np.maximum(sizes, 1.0))
    share = np.minimum(1.0, SAMPLES * weight / max(weight.sum(), 1e-12)).ravel()
    pixels = np.nonzero(np.diff(np.floor(np.cumsum(share)), prepend=0.0) > 0)[0][:SAMPLES]
    rows, columns = weight.shape
    row, column = np.divmod(pixels, columns)
    block = (row * BLOCKS_ACROSS // rows) * BLOCKS_ACROSS + column * BLOCKS_ACROSS // columns
    return pixels[np.argsort(block, kind="stable")].astype(np.int32)


def points_at(view: CanvasView, planes: jax.Array, pixels: NDArray[np.int32]) -> PointSample:
    """Pixels (n,) of a view that lie on planes (3, H, W); on the host, where stacking is cheap."""
    normal = np.asarray(planes).reshape(3, -1)[:, pixels]
    depth, rays = np.asarray(view.depth_m).ravel()[pixels], np.asarray(view.rays).reshape(3, -1)[:, pixels]
    nodes, (row, column) = NodeWeights.of(view), np.divmod(pixels, view.depth_m.shape[1])
    at_pixels = np.concatenate([np.asarray(nodes.rows)[row], np.asarray(nodes.columns)[column]], axis=1)
    unit = normal / np.linalg.norm(normal, axis=0)
    return PointSample(_padded(rays * depth), _padded(unit), _padded(at_pixels.T))


def _padded(columns: NDArray[np.floating]) -> Any:
    return np.pad(columns, ((0, 0), (0, SAMPLES - columns.shape[1]))).astype(np.float32)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _FieldSlopes:
    """How gaps (n,) follow the field at the image's pixels and at the surface's, which these (n,) are."""

    of_image: jax.Array
    of_surface: jax.Array
    pixel: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Gaps:
    """Per sampled pixel (n,): its point and plane normal in the surface's frame (3, n), gap and variance.

    Where a distortion field is given also how the gap follows it. The gap then
    counts in metres as they were measured: in corrected ones it, and all that it costs, would shrink with the
    scene, which the field shrinks at will. For the same reason the point is where the pixel's ray meets the
    plane: slopes at the noisy point would go with the gap itself.
    """

    points: jax.Array
    normals: jax.Array
    gap_m: jax.Array
    variance_m2: jax.Array
    meets: jax.Array
    field: _FieldSlopes | None = None


def _gaps(
    surface: PlaneImage,
    sample: PointSample,
    surface_from_image: jax.Array,
    noise: DepthNoise,
    disparity_per_m: jax.Array | None,
) -> _Gaps:
    pose = jaxlie.SE3(surface_from_image)
    rotation = pose.rotation().as_matrix()
    measured = sample.points[2]
    shrink = jnp.ones_like(measured)
    if disparity_per_m is not None:
        shrink = 1.0 - (disparity_per_m @ sample.node_weights()) * measured
    points = transform(rotation, pose.translation(), sample.points / shrink[None])
    pixel, inside = pixels_of(points, surface.camera, surface.elements.shape[:2])
    element = surface.elements.reshape(-1, surface.elements.shape[-1])[pixel].T
    planes, surface_ray, surface_depth = element[:3], element[3:6], element[6]
    if disparity_per_m is not None:
        inverse_depth = dot(planes, surface_ray)
        distortion = disparity_per_m @ surface.nodes.at(pixel)
        planes = planes * (1.0 - distortion / jnp.where(inverse_depth > 0, inverse_depth, 1.0))[None]
    length = jnp.sqrt(dot(planes, planes))
    normals = planes / jnp.where(length > 0, length, 1.0)[None]
    ray = rotate(rotation, sample.points / jnp.where(measured > 0, measured, 1.0)[None])
    along, surface_along = dot(normals, ray), dot(normals, surface_ray)
    meets = inside & (measured > NO_RETURN) & (length > 0)
    meets &= dot(normals, rotate(rotation, sample.normals)) > LEAST_NORMAL_COSINE
    meets &= along > LEAST_INCIDENCE_COSINE * jnp.sqrt(dot(ray, ray))
    meets &= surface_along > LEAST_INCIDENCE_COSINE * jnp.sqrt(dot(surface_ray, surface_ray))
    sigma = depth_noise.standard_deviation(noise, measured)
    surface_sigma = depth_noise.standard_deviation(noise, surface_depth)
    variance = (sigma * along) ** 2 + (surface_sigma * surface_along) ** 2
    gap = (dot(planes, points) - 1.0) / jnp.where(length > 0, length, 1.0)
    gaps = _Gaps(points, normals, gap, jnp.where(meets, variance, 1.0), meets)
    if disparity_per_m is None:
        return gaps
    back = jnp.where(meets, gap / jnp.where(meets, along, 1.0), 0.0)
    away = jnp.where(meets, 1.0 / jnp.where(meets, length * surface_along, 1.0), 0.0)
    of_image = jnp.where(meets, along * (measured / shrink - back) ** 2, 0.0)
    return replace(
        gaps,
        points=points - ray * back[None],
        gap_m=gap * shrink**2,
        field=_FieldSlopes(of_image, surface_along * away**2, pixel),
    )


def _log_normal(gaps: _Gaps, variance: jax.Array) -> jax.Array:
    return jnp.log1p(-OUTLIER_SHARE) - 0.5 * (gaps.gap_m**2 / variance + jnp.log(2.0 * jnp.pi * variance))


LOG_OUTLIER = float(np.log(OUTLIER_SHARE / OUTLIER_RANGE_M))


@jit_stored()
def overlap_terms(
    surface: PlaneImage,
    samples: PointSample,
    surface_from_images: jax.Array,
    noise: DepthNoise,
    inflation: jax.Array | float,
    disparity_per_m: jax.Array | None = None,
) -> OverlapTerms:
    """Terms of one surface's overlaps with B images, leaves stacked (B, ...).

    Args:
        surface: of one keyframe.
        samples: of B keyframes, leaves (B, ...).
        surface_from_images: (B, 7).
        noise: the sensor.
        inflation: of sigma, over 1 while poses are still far off.
        disparity_per_m: (NODES,) the distortion field, where terms are to tell of it.
    """

    def one(pair: tuple[PointSample, jax.Array]) -> tuple[OverlapTerms, _WeighedGaps | None]:
        sample, pose = pair
        gaps = _gaps(surface, sample, pose, noise, disparity_per_m)
        variance = inflation**2 * gaps.variance_m2
        inlier = jnp.where(gaps.meets, jax.nn.sigmoid(_log_normal(gaps, variance) - LOG_OUTLIER), 0.0)
        weight = inlier / variance
        back = jaxlie.SE3(pose).rotation().as_matrix().T
        normals, own = rotate(back, gaps.normals), rotate(back, gaps.points - pose[4:, None])
        of_surface = [-gaps.normals, -cross(gaps.points, gaps.normals)]
        jacobian = jnp.concatenate([normals, cross(own, normals), *of_surface])
        gradients = jacobian * (weight * gaps.gap_m)[None]
        blocks = gradients.reshape(12, BLOCKS, -1).sum(2)
        of_blocks = jacobian[:6].reshape(6, BLOCKS, -1)
        curvatures = jnp.einsum("ibn,jbn,bn->bij", of_blocks, of_blocks, weight.reshape(BLOCKS, -1))
        by_own_normals = jnp.concatenate([sample.normals, cross(own, sample.normals)])
        shared = (jacobian[:6] * weight[None]) @ by_own_normals.T
        terms = OverlapTerms(
            precision=(jacobian * weight[None]) @ jacobian.T,
            gradient=blocks @ jnp.ones(BLOCKS, blocks.dtype),
            score_variance=score_variance(blocks[:6].T, curvatures),
            information=0.5 * (shared + shared.T),
            inliers=inlier.sum(),
            meeting=gaps.meets.sum(),
            field=None,
        )
        return terms, gaps.field and _WeighedGaps(gaps.gap_m, weight, jacobian, gaps.field)

    terms, weighed = jax.lax.map(one, (samples, surface_from_images))
    if weighed is None:
        return terms
    return replace(terms, field=_field_terms(surface, samples, weighed))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _WeighedGaps:
    """Gaps (n,), their weights (n,), and how they follow displacements (12, n) and the field."""

    gap_m: jax.Array
    weight: jax.Array
    jacobian: jax.Array
    field: _FieldSlopes


def _field_terms(surface: PlaneImage, samples: PointSample, weighed: _WeighedGaps) -> FieldTerms:
    """Of B overlaps, leaves stacked (B, ...).

    A loop of its own: within that of the gaps, these are computed anew for every node (measured, XLA's CPU
    backend).
    """

    def one(pair: tuple[PointSample, _WeighedGaps]) -> FieldTerms:
        sample, gaps = pair
        of_surface = gaps.field.of_surface[None] * surface.nodes.at(gaps.field.pixel)
        of_nodes = gaps.field.of_image[None] * sample.node_weights() - of_surface
        weighted = of_nodes * gaps.weight[None]
        return FieldTerms(weighted @ of_nodes.T, weighted @ gaps.gap_m, gaps.jacobian @ weighted.T)

    return jax.lax.map(one, (samples, weighed))


@jax.jit
def log_overlap_densities(
    surface: PlaneImage,
    samples: PointSample,
    surface_from_images: jax.Array,
    noise: DepthNoise,
) -> jax.Array:
    """Log densities (B, L) of B images' samples (B, ...) given one surface, at poses (B, L, 7).

    Base measure: Lebesgue in metres of each pixel's gap. Counted are the pixels that meet the surface from
    all of the poses: those that come and go at the edges would not compare.
    """

    def at_poses(pair: tuple[PointSample, jax.Array]) -> jax.Array:
        sample, poses = pair
        gaps = jax.vmap(lambda pose: _gaps(surface, sample, pose, noise, None))(poses)
        log_surface = jnp.logaddexp(_log_normal(gaps, gaps.variance_m2), LOG_OUTLIER)
        return jnp.where(gaps.meets.all(0), log_surface, 0.0).sum(1)

    return jax.lax.map(at_poses, (samples, surface_from_images))
