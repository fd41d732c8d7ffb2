"""Global search: scores of candidate poses against all keyframes at once, and ascent from the best.

The reverse projection: a point of the frame lies on the surface of some keyframe, or in space that a keyframe
observed as free, or where no keyframe looked. Nothing is rendered for a candidate: scores say what to look
at, and trees of keyframes are drawn by them; what is found is weighed by the images.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie

from recordings.types import NO_RETURN, DepthNoise
from shapes import depth_noise
from shapes.geometry import pose_gaussian
from shapes.geometry.pose_sets import IDENTITY
from shapes.geometry.vectors import cross, dot, rotate, transform
from slam.keyframes.depth_view import CanvasView
from slam.keyframes.rendering import pixels_of
from slam.keyframes.surfels import SurfelImage
from slam.likelihood.image_density import LOG_ROOT_TWO_PI, STRIDE_PX, unmapped_log_penalty
from slam.registration.alignment import STIFFNESS
from slam.registration.local_map import LocalMap
from slam.registration.local_search import COARSE_STRIDE_PX

SEEN_THROUGH_SIGMAS = 3.0
"""Three sigma."""

CLIMBING_BLURS = (0.04, 0.04, 0.04, 0.03, 0.03, 0.02, 0.02, 0.015)
"""Of the surfaces, relative to depth, in each step uphill: a candidate may be turned by as much."""

SETTLING_BLURS = (0.015, 0.01, 0.01, 0.01)
"""Relative to depth: the last rounds of the ascent, near the sensor's noise."""

SLIDES = tuple(sign * 0.012 * step for step in range(1, 8) for sign in (-1, 1))
"""Along the direction in which a climbed candidate is held least, metres and radians."""

CLIMBING_DAMPING = 0.05
"""Share of the mean precision that holds every direction: round an object on a pedestal only few points tell
of the azimuth, and undamped steps run away from the mode itself (measured)."""

LARGEST_STEP = 0.1
"""Metres or radians."""

LEAST_SHORTFALL = 2.0
"""Nats a point that a search grants the map over what no keyframe saw. That is foreseen from the image
itself, bare walls as well as if they were known, while a grid's neighbours of the right place fit them less
well: places that meet nothing of the map would come first (of 1, 2 and 4 nats the middle one misses least;
docs/model.md, development films)."""

BATCH = 64
"""Candidates scored in one kernel: memory."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Points:
    """The frame on a coarse lattice of P pixels.

    Attributes:
        points: (3, P) in the camera's frame, metres.
        returned: (P,) whether there is one.
        sigma_m: (P,) of its depth.
        unmapped_log_penalty: (P,) log of its factor where no keyframe looked over that on a known surface.
        log_contradicted: () the same in space that a keyframe saw through.
    """

    points: jax.Array
    returned: jax.Array
    sigma_m: jax.Array
    unmapped_log_penalty: jax.Array
    log_contradicted: jax.Array

    def blurred_sigma_m(self, blur: jax.Array | float) -> jax.Array:
        """(P,) where surfaces are blurred by `blur` times the depth: off by an angle, far points err most."""
        return jnp.hypot(self.sigma_m, blur * self.points[2])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Met:
    """What the points (P,) meet from one candidate: the keyframe's surface that explains each best.

    Attributes:
        log_explained: log density of the depth given that surface, -inf without any.
        seen_through: whether a keyframe saw through the point.
        normals: (3, P) of the surface, in the camera's frame.
        gap_m: distance of the point from its plane.
    """

    log_explained: jax.Array
    seen_through: jax.Array
    normals: jax.Array
    gap_m: jax.Array


def _points(view: CanvasView, noise: DepthNoise) -> _Points:
    start, step = COARSE_STRIDE_PX // 2, COARSE_STRIDE_PX // STRIDE_PX
    depth, rays = view.lattice(COARSE_STRIDE_PX, start)
    shortfall = unmapped_log_penalty(view, noise)
    return _Points(
        points=rays * depth[None],
        returned=depth > NO_RETURN,
        sigma_m=depth_noise.standard_deviation(noise, depth),
        unmapped_log_penalty=shortfall[start // STRIDE_PX :: step, start // STRIDE_PX :: step].ravel(),
        log_contradicted=jnp.log(noise.outlier_probability / noise.max_range_m),
    )


def _met(local_map: LocalMap, frame: _Points, blur: jax.Array | float, candidate: jax.Array) -> _Met:
    camera, sigma = jaxlie.SE3(candidate), frame.blurred_sigma_m(blur)
    best = _Met(
        jnp.full(sigma.shape, -jnp.inf),
        jnp.zeros(sigma.shape, bool),
        jnp.zeros_like(frame.points),
        jnp.zeros_like(sigma),
    )
    for index in range(len(local_map.present)):
        keyframe = jax.tree.map(lambda leaf, index=index: leaf[index], local_map.surfaces)
        relative = jaxlie.SE3(local_map.poses[index]).inverse() @ camera
        rotation = relative.rotation().as_matrix()
        points = transform(rotation, relative.translation(), frame.points)
        pixel, inside = pixels_of(points, keyframe.camera)
        planes = keyframe.planes.reshape(3, -1)[:, pixel]
        nearness = dot(planes, points)
        known = inside & (nearness > 0) & local_map.present[index]
        along_ray = points[2] * (1.0 - 1.0 / jnp.where(known, nearness, 1.0))
        log_normal = -0.5 * (along_ray / sigma) ** 2 - jnp.log(sigma) - LOG_ROOT_TWO_PI
        better = known & (log_normal > best.log_explained)
        length = jnp.where(known, jnp.sqrt(dot(planes, planes)), 1.0)
        best = _Met(
            jnp.where(better, log_normal, best.log_explained),
            best.seen_through | (known & (along_ray < -SEEN_THROUGH_SIGMAS * sigma)),
            jnp.where(better[None], rotate(rotation.T, planes / length[None]), best.normals),
            jnp.where(better, (nearness - 1.0) / length, best.gap_m),
        )
    return best


def _score(local_map: LocalMap, frame: _Points, blur: jax.Array | float, candidate: jax.Array) -> jax.Array:
    met = _met(local_map, frame, blur, candidate)
    log_known = -jnp.log(frame.blurred_sigma_m(blur)) - LOG_ROOT_TWO_PI
    log_unknown = log_known + jnp.minimum(frame.unmapped_log_penalty, -LEAST_SHORTFALL)
    otherwise = jnp.where(met.seen_through, frame.log_contradicted, log_unknown)
    return jnp.where(frame.returned, jnp.maximum(met.log_explained, otherwise), 0.0).sum()


def _newton(
    local_map: LocalMap, frame: _Points, pose: jax.Array, blur: jax.Array | float
) -> tuple[jax.Array, jax.Array]:
    """Gauss-Newton curvature (6, 6) and gradient (6,) of minus the score where surfaces explain points."""
    met = _met(local_map, frame, blur, pose)
    inlier = frame.returned * jax.nn.sigmoid(met.log_explained - frame.log_contradicted)
    jacobian = jnp.concatenate([met.normals, cross(frame.points, met.normals)])
    weighted = jacobian * (inlier / frame.blurred_sigma_m(blur) ** 2)[None]
    return weighted @ jacobian.T, weighted @ met.gap_m


@jax.jit
def log_map_scores(
    local_map: LocalMap,
    view: CanvasView,
    noise: DepthNoise,
    candidates: jax.Array,
    blur: jax.Array | float,
) -> jax.Array:
    """Approximate log densities (C,) of a frame at candidates (C, 7) that may be far apart.

    Surfaces are blurred by `blur` times the depth: a coarse grid of candidates must not step over a mode.
    """
    frame = _points(view, noise)
    return jax.lax.map(partial(_score, local_map, frame, blur), candidates, batch_size=BATCH)


@jax.jit
def log_scores_of_maps(
    surfaces: SurfelImage,
    present: jax.Array,
    poses: jax.Array,
    view: CanvasView,
    noise: DepthNoise,
    blur: jax.Array | float,
) -> jax.Array:
    """Approximate log densities (C,) of a frame in maps of those of M surfaces that are present (M,).

    Args:
        surfaces: stacked.
        present: bool; one kernel serves maps of all sizes.
        poses: (C, M, 7) camera_from_keyframe.
        view: the frame.
        noise: of the sensor.
        blur: of surfaces, relative to depth.
    """
    frame, here = _points(view, noise), jnp.asarray(IDENTITY, jnp.float32)

    def score(poses: jax.Array) -> jax.Array:
        return _score(LocalMap(surfaces, present, poses), frame, blur, here)

    return jax.lax.map(score, poses, batch_size=BATCH)


@jax.jit
def ascend(local_map: LocalMap, view: CanvasView, noise: DepthNoise, candidates: jax.Array) -> jax.Array:
    """Candidates (C, 7) uphill: steps on surfaces that are blurred less and less, a slide, and steps again.

    Round an object on a pedestal few points tell of the azimuth: a grid's neighbours climb to the right
    height and tilt, and stay beside the mode.
    """
    frame = _points(view, noise)

    def step(pose: jax.Array, blur: jax.Array) -> tuple[jax.Array, None]:
        precision, gradient = _newton(local_map, frame, pose, blur)
        held = STIFFNESS + CLIMBING_DAMPING * jnp.repeat(jnp.diagonal(precision).reshape(2, 3).mean(1), 3)
        offset = -jnp.linalg.solve(precision + jnp.diag(held), gradient)
        offset *= LARGEST_STEP / jnp.maximum(jnp.abs(offset).max(), LARGEST_STEP)
        return pose_gaussian.displace(pose, offset), None

    def slid(pose: jax.Array) -> jax.Array:
        blur = SETTLING_BLURS[-1]
        precision, _ = _newton(local_map, frame, pose, blur)
        _, directions = jnp.linalg.eigh(precision)
        offsets = jnp.outer(jnp.asarray((0.0, *SLIDES), pose.dtype), directions[:, 0])
        poses = jax.vmap(partial(pose_gaussian.displace, pose))(offsets)
        return poses[jnp.argmax(jax.lax.map(partial(_score, local_map, frame, blur), poses))]

    def climb(candidate: jax.Array) -> jax.Array:
        pose, _ = jax.lax.scan(step, candidate, jnp.asarray(CLIMBING_BLURS, candidate.dtype))
        return jax.lax.scan(step, slid(pose), jnp.asarray(SETTLING_BLURS, candidate.dtype))[0]

    return jax.lax.map(climb, candidates, batch_size=BATCH)
