"""What is told of frames: the spread of the keyframe that carries a frame is part of the frame's."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from recordings.types import CameraIntrinsics
from shapes.geometry import pose_gaussian
from shapes.geometry.pose_sets import IDENTITY
from slam.filter.init import first_frame_info
from slam.filter.state import Ties
from slam.history import History
from slam.likelihood.distortion import NODES
from slam.pose_graph.refinement import MapMixture, PlacedKeyframes, RefinedKeyframes
from slam.smoothing import _by_ties, _drawn, _marginals, _roots, _spread, smoothed
from tests.statistical import assert_mean


def _pose(*tangent: float) -> jax.Array:
    return jaxlie.SE3.exp(jnp.asarray(tangent, jnp.float32)).wxyz_xyz


ANCHOR, DRAWN = _pose(0.3, 0.2, -0.1, 0.5, 0.2, -0.4), _pose(0.1, 0.0, 0.0, 0.0, 0.1, 0.0)
RELATIVE = _pose(0.1, 0.7, 0.3, -0.3, 0.6, 0.2)
CAMERA = CameraIntrinsics(width=8, height=6, fx=8.0, fy=8.0, cx=3.5, cy=2.5)


def _placed(poses: jax.Array, held: list[bool], sensitivity: np.ndarray) -> RefinedKeyframes:
    """One map of keyframes (N, 7) without spread."""
    return RefinedKeyframes(
        mode=np.zeros(2, int),
        drawn=np.tile(np.asarray(poses), (2, 1, 1)),
        poses=np.asarray(poses)[None],
        covariances=np.zeros((1, len(poses), 6, 6)),
        held=np.asarray([held]),
        factor=np.zeros((1, 63, 3)),
        disparity_per_m=np.zeros((1, 63)),
        sd_per_m=np.ones((1, 63)),
        sensitivity=sensitivity[None],
    )


def _one_map(poses: jax.Array) -> MapMixture:
    """Of keyframes (N, 7), as the only hypothesis has them."""
    return MapMixture(
        poses=np.asarray(poses)[None],
        probabilities=np.ones(1),
        hypotheses=np.zeros(1, int),
        known=(None,),
    )


def test_a_frame_follows_each_keyframe_in_what_that_one_told_of_it(seed):
    """Three have moved apart since: the frame goes where their quadratics, of different axes, are least.

    The field's displacements are those of keyframes that follow it; one that nothing holds has no say.
    """
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(3, 6, 3))
    precisions = factors @ factors.transpose(0, 2, 1) + 0.1 * np.eye(6)
    shares = np.linalg.inv(precisions.sum(axis=0)) @ precisions
    keyframes_from_camera = jnp.stack([RELATIVE, ANCHOR, DRAWN])
    found = jax.vmap(lambda relative: (jaxlie.SE3(DRAWN) @ jaxlie.SE3(relative).inverse()).wxyz_xyz)(
        keyframes_from_camera
    )
    moves = rng.normal(scale=3e-3, size=(3, 6))
    refined = jax.vmap(pose_gaussian.displace)(found, jnp.asarray(moves, jnp.float32))
    of_field = rng.normal(size=(3, 6, 2))

    def camera_moves(moved: jax.Array) -> np.ndarray:
        cameras = jax.vmap(lambda one, relative: (jaxlie.SE3(one) @ jaxlie.SE3(relative)).wxyz_xyz)(
            moved, keyframes_from_camera
        )
        return np.asarray(jax.vmap(pose_gaussian.coordinates, (None, 0))(DRAWN, cameras))

    ties = Ties(
        np.asarray([[[0, 1, 2]]], np.int32),
        np.asarray(keyframes_from_camera)[None, None],
        shares[None, None].astype(np.float32),
    )
    held, astray = (
        PlacedKeyframes.stacked(_placed(refined, are_held, of_field), ties.keyframes)
        for are_held in ([True] * 3, [True, False, False])
    )
    pulled, following = _by_ties(held, ties)
    alone, _ = _by_ties(astray, ties)

    own = camera_moves(refined)
    best = np.linalg.solve(precisions.sum(axis=0), np.einsum("mij,mj->i", precisions, own))
    np.testing.assert_allclose(own[0] + np.asarray(pulled)[0, 0], best, atol=3e-4)
    np.testing.assert_array_equal(alone, 0.0)
    along = 1e-3 * np.asarray([0.7, -0.4])
    steps = jnp.asarray(of_field @ along, jnp.float32)
    by_field = camera_moves(jax.vmap(pose_gaussian.displace)(found, steps))
    expected = np.einsum("mij,mj->i", shares, by_field - by_field[0])
    np.testing.assert_allclose(np.asarray(following)[0, 0] @ along, expected, atol=3e-5)


def test_the_spread_of_a_keyframe_is_carried_to_its_frames(seed):
    """As by autodiff, the distortion field's included, beside the frame's own."""
    rng = np.random.default_rng(seed)
    factor, of_keyframe, of_frame = rng.normal(size=(6, 6)), rng.normal(size=(6, 3)), rng.normal(size=(6, 3))
    placed = replace(
        _placed(
            jnp.stack([jnp.asarray(IDENTITY), ANCHOR]),
            [True, True],
            np.stack([0 * of_keyframe, of_keyframe]),
        ),
        covariances=np.stack([0 * factor, factor @ factor.T])[None],
    )

    spread = _spread(
        PlacedKeyframes.stacked(placed, np.asarray([[0, 1]])),
        jnp.tile(RELATIVE, (1, 2, 1)),
        jnp.tile(jnp.eye(6), (1, 2, 1, 1)),
        jnp.asarray(np.stack([of_frame, of_frame])[None], jnp.float32),
    )

    def moved(xi: jax.Array) -> jax.Array:
        displaced = jaxlie.SE3(pose_gaussian.displace(ANCHOR, xi)) @ jaxlie.SE3(RELATIVE)
        camera = jaxlie.SE3(ANCHOR) @ jaxlie.SE3(RELATIVE)
        return pose_gaussian.coordinates(camera.wxyz_xyz, displaced.wxyz_xyz)

    jacobian = np.asarray(jax.jacfwd(moved)(jnp.full(6, 1e-4)))
    following = of_frame + jacobian @ of_keyframe
    expected = np.eye(6) + jacobian @ factor @ factor.T @ jacobian.T
    expected = expected + following @ following.T
    alone = np.eye(6) + of_frame @ of_frame.T
    np.testing.assert_allclose(spread[0, 1], expected, rtol=0.01, atol=0.02)
    np.testing.assert_allclose(spread[0, 0], alone, rtol=1e-4, atol=1e-4)


def test_draws_have_the_spread_of_a_frame_about_its_drawn_keyframe(key, seed):
    """Also where a direction has none; each is of its own anchor."""
    count = 4000
    factor = np.random.default_rng(seed).normal(scale=0.02, size=(6, 6))
    factor[2] = 0.0
    covariance = jnp.asarray(factor @ factor.T, jnp.float32)
    anchors = jnp.tile(jnp.stack([ANCHOR, DRAWN])[None], (count, 1, 1))
    roots = jnp.tile(_roots(covariance), (count, 2, 1, 1))

    drawn = _drawn(jax.random.split(key, 2), anchors, jnp.tile(RELATIVE, (count, 2, 1)), roots)

    for number, anchor in enumerate((ANCHOR, DRAWN)):
        centre = (jaxlie.SE3(anchor) @ jaxlie.SE3(RELATIVE)).wxyz_xyz
        tangents = np.asarray(jax.vmap(pose_gaussian.coordinates, (None, 0))(centre, drawn[:, number]))
        np.testing.assert_allclose(tangents[:, 2], 0.0, atol=1e-4)
        upper = np.triu_indices(6)
        moments = (tangents[:, :, None] * tangents[:, None, :])[:, *upper]
        varying = moments.std(axis=0) > 1e-8
        assert_mean(moments[:, varying], np.asarray(covariance)[upper][varying], detectable=1e-3)


def test_the_marginal_of_several_maps_is_about_the_likeliest(seed):
    """Second moments of all about its mean: .3 of the mass a metre off has that in its variance."""
    factor = np.random.default_rng(seed).normal(scale=0.01, size=(2, 6, 6))
    spread = factor @ factor.transpose(0, 2, 1)
    shift = np.asarray([1.0, -0.5, 0.2, 0.0, 0.0, 0.0])
    there = pose_gaussian.displace(ANCHOR, jnp.asarray(shift, jnp.float32))

    mean, covariance = _marginals(
        jnp.stack([there, ANCHOR])[:, None], jnp.asarray(spread)[:, None], jnp.asarray([0.3, 0.7])
    )

    expected = 0.3 * (spread[0] + np.outer(shift, shift)) + 0.7 * spread[1]
    np.testing.assert_array_equal(mean[0], ANCHOR)
    np.testing.assert_allclose(covariance[0], expected, atol=1e-4)


def test_what_a_search_may_not_have_found_is_told_more_widely_of_each_further_keyframe(key):
    """The reference stays certain; without a search nothing is added."""
    poses = jnp.stack([jnp.asarray(IDENTITY), ANCHOR, DRAWN])
    history = History()
    for number in range(3):
        history.append(number, replace(first_frame_info(4), keyframes=number + 1))
    placed = replace(_placed(poses, [True] * 3, np.zeros((3, 6, 3))), factor=np.zeros((1, NODES, 3)))
    step = np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03])
    sure = _one_map(poses)

    told, unsure = (
        smoothed(key, history, maps, placed, CAMERA).covariance
        for maps in (sure, replace(sure, undiscovered=0.25, unseen_step=step))
    )

    np.testing.assert_allclose(told, 0.0, atol=1e-6)
    np.testing.assert_allclose(unsure, 0.25 * np.stack([0.0 * step, step, 2.0 * step]), atol=1e-6)


def test_the_reported_covariance_is_that_of_the_heavier_tails(key):
    """A Student-t of 13 degrees of freedom has 13/11 of the square of its scale as its covariance.

    Of a keyframe whose own is known, at which the frame stands; what a second motion leaves open is added.
    """
    poses = jnp.stack([jnp.asarray(IDENTITY), ANCHOR])
    displacements = np.random.default_rng(0).normal(scale=0.02, size=(6, 8)).astype(np.float32)
    first = first_frame_info(4)
    history = History()
    for number, doubt in enumerate((first.doubt, replace(first.doubt, displacements=displacements))):
        history.append(number, replace(first, keyframes=number + 1, doubt=doubt))
    of_noise = np.diag([0.01, 0.02, 0.03, 0.001, 0.002, 0.003])
    placed = replace(
        _placed(poses, [True] * 2, np.zeros((2, 6, 3))),
        factor=np.zeros((1, NODES, 3)),
        covariances=np.stack([0.0 * of_noise, of_noise])[None],
    )

    result = smoothed(key, history, _one_map(poses), placed, CAMERA)

    freedom = float(result.degrees_of_freedom)
    open_to = displacements.astype(np.float64) @ displacements.T
    expected = np.stack([0.0 * of_noise, freedom / (freedom - 2.0) * of_noise + open_to])
    np.testing.assert_allclose(result.covariance, expected, atol=1e-6)
    assert freedom == 13.0
