"""The density of the image: normalised, differentiated rightly, and true to a rendering at the candidate."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import trapezoid

from recordings.types import DepthNoise
from shapes.geometry import pose_gaussian, pose_sets
from shapes.geometry.poses import single_precision_poses
from slam.keyframes.depth_view import block_reduce, view_of_frame
from slam.keyframes.planes import region_planes
from slam.keyframes.rendering import depth_on_rays, fused_planes, planes_in_frame, render
from slam.keyframes.surfels import surfel_image
from slam.likelihood.image_density import (
    ScoredPixels,
    log_density_of_mapped,
    log_image_density,
    log_pixel_factors,
    rendered_depth,
    scored_pixels,
)
from slam.likelihood.unmapped_depth import PredictedDepth, log_density_of_unknown, predict_from_neighbours
from slam.registration.alignment import depth_and_jacobian, pixel_terms
from slam.registration.local_map import LocalMap
from slam.registration.local_search import optimum_at
from tests.slam import box_room

NOISE = DepthNoise()
IDENTITY = jnp.asarray(pose_sets.IDENTITY, jnp.float32)


def _displaced(xi: list[float]) -> jax.Array:
    return pose_gaussian.displace(IDENTITY, jnp.asarray(xi, jnp.float32))


@jax.jit
def _rendered(local_map, camera_pose, view):
    poses = local_map.keyframes_from_camera(camera_pose)
    return render(local_map.surfaces, local_map.present, poses, view.rays, view.camera)


@jax.jit
def _scored(local_map, camera_pose, view):
    poses = local_map.keyframes_from_camera(camera_pose)
    image = _rendered(local_map, camera_pose, view)
    return scored_pixels(view, image, local_map.surfaces, local_map.present, poses, NOISE)


@jax.jit
def _surfels(view):
    return surfel_image(view, NOISE)


def _local_map(keyframe_poses: np.ndarray) -> LocalMap:
    views = [view_of_frame(frame, box_room.INTRINSICS) for frame in box_room.frames(keyframe_poses, seed=1)]
    surfaces = [_surfels(view) for view in views]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *surfaces)
    return LocalMap(stacked, jnp.ones(len(views), bool), single_precision_poses(keyframe_poses))


@jax.jit
def _log_density(pixels, poses):
    return log_image_density(pixels, poses, NOISE, 1.0)


@jax.jit
def _foreseen(image):
    return predict_from_neighbours(image, NOISE)


@pytest.mark.parametrize("expected", [(0.0, 0.0, 0.0), (1.52, 1.5, 1.4), (0.0, 0.0, 2.0), (0.6, 0.6, 0.6)])
@pytest.mark.parametrize("depth", [None, 0.8, 2.0, 9.0])
@pytest.mark.parametrize("in_front", [False, True])
def test_returns_have_a_normalised_density(expected, depth, in_front):
    """Integral over the real line is one, whether the map shows something or nothing."""
    with jax.enable_x64(True):
        z = jnp.linspace(-0.5, 10.5, 400_001)
        known = expected[0] > 0
        share, uncertainty = jnp.full(1, 0.9 if known else 0.0), jnp.full(1, 0.3 if known else 0.0)
        foreseen = PredictedDepth(jnp.asarray(expected)[:, None], share, uncertainty, jnp.full(1, 0.1))
        if depth is None:
            density = log_density_of_unknown(z, foreseen, NOISE)
        else:
            surface = (jnp.asarray(depth), jnp.asarray(0.004))
            density = log_density_of_mapped(z, foreseen, jnp.asarray([in_front]), *surface, NOISE)

        total = trapezoid(np.exp(np.asarray(density)), np.asarray(z))

    assert total == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("mapped", [False, True])
@pytest.mark.parametrize("border", [False, True])
def test_a_return_or_none_has_a_normalised_density(mapped: bool, border: bool) -> None:
    """The atom of no return and the integral over returns are one, of pixels that differ in depth alone."""
    with jax.enable_x64(True):
        z = np.linspace(0.02, 10.5, 200_001)
        every = np.ones(len(z) + 1)
        foreseen = np.tile(1.5 * every, (3, 1)), 0.9 * every, 0.3 * every, 0.3 * every
        pixels = ScoredPixels(
            observed_m=jnp.append(jnp.asarray(z), 0.0),
            measured=jnp.asarray(every > 0),
            foreseen=PredictedDepth(*map(jnp.asarray, foreseen)),
            in_front=jnp.asarray(every < 0),
            border=jnp.asarray((every > 0) & border),
            rays=jnp.asarray(np.outer([0.0, 0.0, 1.0], every)),
            planes=jnp.asarray(np.outer([0.0, 0.0, 0.5], every))[None],
            weights=jnp.asarray((0.004**-2.0 if mapped else 0.0) * every)[None],
        )
        at_the_keyframe = jnp.asarray([[1.0, 0, 0, 0, 0, 0, 0]])
        factors = np.exp(np.asarray(log_pixel_factors(pixels, at_the_keyframe, NOISE)[0]))

    assert factors[-1] == pytest.approx(0.3)
    assert factors[-1] + trapezoid(factors[:-1], z) == pytest.approx(1.0, abs=3e-3)


def test_a_hole_is_foreseen_by_its_neighbours_and_says_nothing_of_the_place():
    """Inside a patch without returns the next is hardly news, alone it is; the map has no part in it."""
    depth = jnp.asarray(box_room.depth_image(box_room.pose(0, 0, 0, 0.2)))
    view = view_of_frame(box_room.frames(box_room.pose(0, 0, 0, 0.2)[None])[0], box_room.INTRINSICS)
    holed = replace(view, depth_m=view.depth_m.at[40:60, 40:60].set(0.0))
    none = np.asarray(_foreseen(depth.at[40:60, 40:60].set(0.0)[::2, ::2]).none)
    here = single_precision_poses(box_room.pose(0, 0, 0, 0.2))
    pixels = _scored(_local_map(box_room.pose(0, 0, 0, 0.2)[None]), here, holed)

    def lost(weights: jax.Array) -> float:
        """By how much the density of the image is less than that of its returns."""
        shown = replace(pixels, weights=weights)
        returns = replace(shown, measured=pixels.measured & (pixels.observed_m > 0))
        poses = _local_map(box_room.pose(0, 0, 0, 0.2)[None]).keyframes_from_camera(here)
        return float(_log_density(returns, poses) - _log_density(shown, poses))

    assert none[20, 20] < 0.05 < 0.9 < none[25, 25]
    assert lost(pixels.weights) == pytest.approx(lost(jnp.zeros_like(pixels.weights)), abs=0.1)


def test_unknown_pixels_look_at_those_before_alone():
    """A change of one pixel changes no expectation before it; on a plane all but the last are exact."""
    depth = jnp.asarray(box_room.depth_image(box_room.pose(0, 0, 0, 0.2)))[::2, ::2]
    changed = depth.at[20, 30].add(0.3)

    before, after = (_foreseen(image) for image in (depth, changed))
    changes = [
        np.asarray(one != other).reshape(-1, *before.share.shape).any(axis=0)
        for one, other in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True)
    ]
    difference = np.any(changes, axis=0)
    around, planar, _ = np.asarray(before.depth_m)

    assert not difference[:20].any()
    assert not difference[20, :31].any()
    assert difference[20, 31]
    assert difference[21, 30]
    assert (around > 0)[2:, 2:-2].mean() > 0.7
    assert np.median(np.abs(around - np.asarray(depth))[around > 0]) < 1e-5
    assert np.median(np.abs(planar - np.asarray(depth))[:, 2:]) < 1e-5


def test_an_unknown_wall_is_foreseen_almost_as_well_as_a_known_one():
    """Within 0.5 nats a return of the density that knows the room, noise and outliers included.

    What a wrong place gains by covering more of the image is this difference.
    """
    pose = box_room.pose(0, 0, 0, 0.2)
    true = jnp.asarray(box_room.depth_image(pose))[::2, ::2]
    seen = jnp.asarray(box_room.frames(pose[None], seed=11)[0].depth_m)[::2, ::2]
    sigma = NOISE.sigma_base_m + NOISE.sigma_growth_per_m * (true - 0.4) ** 2

    foreseen = _foreseen(seen)
    unknown = log_density_of_unknown(seen, foreseen, NOISE)
    known = log_density_of_mapped(seen, foreseen, jnp.zeros(seen.shape, bool), true, 0.1 * sigma, NOISE)

    inner = np.s_[4:, 4:-4]
    difference = np.asarray(known - unknown)[inner][np.asarray(seen)[inner] > 0]
    assert 0.0 < difference.mean() < 0.5


def test_something_in_front_is_foreseen_where_no_keyframe_could_see_it():
    """An object's back costs what the unknown costs, its end log 5; seen-through space still contradicts."""
    behind, sigma = jnp.asarray([2.0]), jnp.asarray(0.004)
    foreseen = PredictedDepth(jnp.full((3, 1), 1.0), jnp.asarray([0.9]), jnp.zeros(1), jnp.full(1, 0.02))

    def factor(observed: float, in_front: bool) -> float:
        seen = jnp.asarray([observed])
        return float(log_density_of_mapped(seen, foreseen, jnp.asarray([in_front]), behind, sigma, NOISE)[0])

    unknown = float(log_density_of_unknown(jnp.asarray([1.0]), foreseen, NOISE)[0])

    assert factor(1.0, in_front=True) > unknown - 0.3
    assert factor(1.0, in_front=False) < unknown - 4.0
    assert factor(2.0, in_front=False) - np.log(5.0) - 0.1 < factor(2.0, in_front=True)


def test_what_no_keyframe_could_see_may_stand_in_front():
    """A thing nearer than the map: a keyframe ahead of it leaves room for it, one behind saw through it."""
    here, ahead = box_room.pose(0, 0, 0, 0.2), box_room.pose(0.2, 0, 0.98, 0.2)
    view = view_of_frame(box_room.frames(here[None])[0], box_room.INTRINSICS)
    nearer = replace(view, depth_m=0.3 * view.depth_m)
    camera, map_ahead = single_precision_poses(here), _local_map(ahead[None])

    seen_through = _scored(_local_map(here[None]), camera, nearer).in_front
    possible = _scored(map_ahead, camera, nearer)
    unchanged = _scored(map_ahead, camera, view).in_front

    shown = np.asarray(possible.weights).sum(0) > 0
    assert np.asarray(seen_through).mean() < 0.02
    assert np.asarray(possible.in_front)[shown].mean() > 0.8
    assert np.asarray(unchanged)[shown].mean() < 0.05


def test_planes_render_the_same_in_any_frame():
    """A plane moved to another camera is met at the depth of the moved point; its back is not seen."""
    points = jnp.asarray([[0.1, -0.2, 2.0], [0.5, 0.3, 1.0], [-0.4, 0.1, 3.0]]).T
    normals = jnp.asarray([[0.1, 0.2, -1.0], [0.3, -0.1, -1.0], [0.0, 0.4, -1.0]]).T
    planes = normals / (normals * points).sum(0)[None]
    pose = _displaced([0.2, -0.1, 0.3, 0.1, -0.2, 0.05])
    rotation = np.asarray(pose_gaussian.jaxlie.SE3(pose).rotation().as_matrix())
    seen = (np.asarray(points).T - np.asarray(pose[4:])) @ rotation

    depth = depth_on_rays(planes_in_frame(planes, pose), jnp.asarray((seen / seen[:, 2:]).T, jnp.float32))
    behind = depth_on_rays(planes_in_frame(planes, _displaced([0, 0, 5.0, 0, 0, 0])), jnp.asarray(points))

    np.testing.assert_allclose(depth, seen[:, 2], rtol=1e-5)
    assert not np.isfinite(np.asarray(behind)).any()


def test_planes_of_walls_are_the_walls():
    """Away from edges the fitted normals of an exact image are those of the room, to a tenth of a degree."""
    view = view_of_frame(box_room.frames(box_room.pose(0, 0, 0, 0.3)[None])[0], box_room.INTRINSICS)
    planes = np.asarray(region_planes(view, NOISE)[0])
    normals = planes / np.linalg.norm(planes, axis=0)
    world = np.einsum("ij,jhw->ihw", box_room.pose(0, 0, 0, 0.3)[:3, :3], normals)

    alignment = np.abs(world).max(0)

    assert np.mean(alignment > np.cos(np.radians(0.1))) > 0.85


def test_jacobian_of_rendered_depth_is_that_of_autodiff(key):
    """Analytic derivatives of depth in the pose agree with forward-mode differentiation."""
    with jax.enable_x64(True):
        planes = jnp.asarray([[0.05, 0.1, 0.5], [-0.2, 0.1, 0.8], [0.3, -0.3, 0.4]]).T
        rays = jnp.asarray([[0.1, -0.2, 1.0], [0.4, 0.1, 1.0], [-0.3, 0.2, 1.0]]).T
        pose = pose_gaussian.displace(IDENTITY.astype(jnp.float64), 0.1 * jax.random.normal(key, (6,)))

        _, jacobian = depth_and_jacobian(planes, rays, pose)
        expected = jax.jacfwd(
            lambda xi: depth_and_jacobian(planes, rays, pose_gaussian.displace(pose, xi))[0]
        )(jnp.zeros(6))

    np.testing.assert_allclose(jacobian, expected.T, rtol=1e-6, atol=1e-9)


def test_gradient_and_curvature_are_those_of_the_log_density(key):
    """Scores and Gauss-Newton curvature of the pixels against autodiff of their mixture density.

    Sigma's own dependence on the pose is left out of Gauss-Newton: the noise is constant here.
    """
    noise = DepthNoise(sigma_base_m=0.01, sigma_growth_per_m=0.0)
    view = view_of_frame(box_room.frames(box_room.pose(0, 0, 0)[None])[0], box_room.INTRINSICS)
    surface = surfel_image(view, noise)
    with jax.enable_x64(True):
        planes = jnp.asarray(surface.planes, jnp.float64).reshape(3, -1)[:, ::7]
        rays = jnp.asarray(view.rays, jnp.float64).reshape(3, -1)[:, ::7]
        truth = depth_on_rays(planes, rays)
        observed = truth + 0.01 * jax.random.normal(key, truth.shape)
        pose = pose_gaussian.displace(IDENTITY.astype(jnp.float64), jnp.full(6, 1e-3))
        variance = jnp.full(truth.shape, 1e-6)

        def log_density(xi: jax.Array) -> jax.Array:
            from shapes import depth_noise

            depth, _ = depth_and_jacobian(planes, rays, pose_gaussian.displace(pose, xi))
            return depth_noise.log_density_of_hit(noise, observed, depth, jnp.sqrt(variance)).sum()

        terms = jax.jit(pixel_terms)(planes, variance, observed, rays, pose, noise)
        gradient = np.asarray(jax.jit(jax.grad(log_density))(jnp.zeros(6)))
        hessian = np.asarray(jax.jit(jax.hessian(log_density))(jnp.zeros(6)))
        scores, precision = np.asarray(terms.scores()), np.asarray(terms.precision())

    scale = float(np.abs(gradient).max())
    np.testing.assert_allclose(scores.sum(1), gradient, rtol=1e-6, atol=1e-6 * scale)
    relative = np.linalg.solve(precision, -hessian)
    np.testing.assert_allclose(np.linalg.eigvals(relative).real, 1.0, atol=0.1)


def test_rendering_shows_what_the_camera_would_see():
    """Depth rendered from two noisy keyframes is the room's own depth, to the noise."""
    local_map = _local_map(np.stack([box_room.pose(0, 0, 0), box_room.pose(0.2, 0, 0, 0.2)]))
    target = box_room.pose(0.1, 0.05, 0.1, 0.1)
    view = view_of_frame(box_room.frames(target[None])[0], box_room.INTRINSICS)
    keyframes_from_camera = local_map.keyframes_from_camera(single_precision_poses(target))

    image = _rendered(local_map, single_precision_poses(target), view)
    planes, _ = jax.jit(fused_planes)(image, keyframes_from_camera)
    rendered = np.asarray(depth_on_rays(planes, view.rays))

    error = rendered - np.asarray(view.depth_m)
    assert np.isfinite(error).mean() > 0.95
    assert np.median(np.abs(error[np.isfinite(error)])) < 0.005


def test_compiled_fusion_equals_plain_numpy():
    """XLA's CPU backend has miscompiled sums over layers; the fused planes must not be among them."""
    local_map = _local_map(np.stack([box_room.pose(0.05 * i, 0, 0, 0.05 * i) for i in range(4)]))
    view = view_of_frame(box_room.frames(box_room.pose(0.1, 0, 0)[None])[0], box_room.INTRINSICS)
    poses = local_map.keyframes_from_camera(single_precision_poses(box_room.pose(0.1, 0, 0)))
    image = render(local_map.surfaces, local_map.present, poses, view.rays, view.camera)

    fused, _ = jax.jit(fused_planes)(image, poses)

    moved = np.stack([np.asarray(planes_in_frame(image.planes[i], poses[i])) for i in range(4)])
    weights = np.asarray(image.weights)[:, None]
    expected = (weights * moved).sum(0) / np.maximum(weights.sum(0), 1e-9)
    np.testing.assert_allclose(np.asarray(fused), expected, rtol=1e-4, atol=1e-5)


def test_candidates_compare_alike_under_either_of_two_renderings():
    """Differences between candidates, which alone make weights, hardly depend on where the map was rendered.

    (The level does: which element a pixel sees changes by rounding, for all candidates alike.)
    """
    truth = box_room.pose(0.08, 0.02, 0.05, 0.06)
    local_map = _local_map(np.stack([box_room.pose(0, 0, 0), box_room.pose(0.2, 0, 0, 0.15)]))
    view = view_of_frame(box_room.frames(truth[None], seed=3)[0], box_room.INTRINSICS)
    optimum = jax.jit(optimum_at)(local_map, view, NOISE, single_precision_poses(truth))
    exponent = 0.05
    spread = jnp.linalg.cholesky(jnp.linalg.inv(exponent * optimum.layer_precisions.sum(0)))
    steps = jnp.concatenate([spread, -spread], axis=1)
    candidates = [pose_gaussian.displace(optimum.pose, step) for step in steps.T]

    def tempered(centre: jax.Array) -> np.ndarray:
        pixels = _scored(local_map, centre, view)
        poses = [local_map.keyframes_from_camera(pose) for pose in [optimum.pose, *candidates]]
        return exponent * np.asarray([float(_log_density(pixels, one)) for one in poses])

    here, there = tempered(optimum.pose), tempered(candidates[0])

    # Both ways together the slope at the optimum falls out, and half a nat is lost in every direction.
    np.testing.assert_allclose((here[1:7] + here[7:]) / 2 - here[0], -0.5, atol=0.03)
    np.testing.assert_allclose(here - here[0], there - there[0], atol=1.5)


def test_a_pose_that_turns_away_from_the_rendering_gains_nothing():
    """Its pixels stay held against the elements that they saw, and are not foreseen as the unknown."""
    truth = single_precision_poses(box_room.pose(0.08, 0.02, 0.05, 0.06))
    local_map = _local_map(np.stack([box_room.pose(0, 0, 0)]))
    frame = box_room.frames(box_room.pose(0.08, 0.02, 0.05, 0.06)[None], seed=3)[0]
    view = view_of_frame(frame, box_room.INTRINSICS)
    pixels = _scored(local_map, truth, view)
    nowhere = replace(pixels, weights=jnp.zeros_like(pixels.weights))
    turned = pose_gaussian.displace(truth, jnp.asarray([0, 0, 0, 0, 3.0, 0], jnp.float32))

    def density(pixels, pose):
        return float(_log_density(pixels, local_map.keyframes_from_camera(pose)))

    assert density(pixels, truth) > density(nowhere, truth) > density(pixels, turned) + 1000.0


def test_float32_differences_of_log_densities_are_those_of_float64():
    """Differences between candidates are good to 0.1 nat in float32."""
    truth = box_room.pose(0.08, 0.02, 0.05, 0.06)
    local_map = _local_map(np.stack([box_room.pose(0, 0, 0)]))
    view = view_of_frame(box_room.frames(truth[None], seed=3)[0], box_room.INTRINSICS)
    near = local_map.keyframes_from_camera(single_precision_poses(truth))
    pixels = _scored(local_map, single_precision_poses(truth), view)
    moved = near.at[0, 4:].add(jnp.asarray([0.001, -0.001, 0.001]))
    single = float(_log_density(pixels, moved))
    single -= float(_log_density(pixels, near))

    with jax.enable_x64(True):
        wide = jax.tree.map(
            lambda leaf: leaf if leaf.dtype == bool else jnp.asarray(leaf, jnp.float64), pixels
        )
        double = float(
            _log_density(wide, jnp.asarray(moved, jnp.float64))
            - _log_density(wide, jnp.asarray(near, jnp.float64))
        )

    assert single == pytest.approx(double, abs=0.1)


def test_blocks_average_their_nearest_surface_alone():
    """A block over an edge takes the front if that is at least half of it, and nothing otherwise."""
    depth = jnp.asarray(
        [[1.0, 1.0, 2.0, 2.0], [1.01, 2.0, 2.02, 1.0], [0.0, 3.0, 0.0, 0.0], [3.03, 3.0, 4.0, 0.0]]
    )

    reduced = np.asarray(block_reduce(depth, 2))

    np.testing.assert_allclose(reduced, [[(1.0 + 1.0 + 1.01) / 3, 0.0], [3.01, 0.0]], atol=1e-6)


def test_lattice_sees_planes_of_pixels():
    """Rendered depth of the lattice at the rendering's own pose is the rendering's."""
    local_map = _local_map(np.stack([box_room.pose(0, 0, 0)]))
    view = view_of_frame(box_room.frames(box_room.pose(0.05, 0, 0)[None])[0], box_room.INTRINSICS)
    here = single_precision_poses(box_room.pose(0.05, 0, 0))
    poses = local_map.keyframes_from_camera(here)
    image = _rendered(local_map, here, view)

    depth, _ = rendered_depth(_scored(local_map, here, view), poses)

    planes, _ = fused_planes(image, poses)
    expected = np.asarray(depth_on_rays(planes, view.rays))[::2, ::2].ravel()
    np.testing.assert_allclose(np.asarray(depth), expected, rtol=1e-4)
