"""Densities of poses against their own samplers, all in one base measure."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from shapes.geometry import pose_gaussian, pose_sets
from slam.filter.motion import FreeMotion, MotionHistory, OrbitMotion
from tests.statistical import assert_mean

IDENTITY = jnp.asarray(pose_sets.IDENTITY, jnp.float32)


def _pose(xi: list[float]) -> jax.Array:
    return pose_gaussian.displace(IDENTITY, jnp.asarray(xi, jnp.float32))


def _scale(metres: float, radians: float) -> jax.Array:
    return jnp.diag(jnp.asarray([metres] * 3 + [radians] * 3, jnp.float32))


def test_coordinates_undo_displacements(key):
    """Displaced and coordinates are inverse to each other."""
    xi = 0.5 * jax.random.normal(key, (50, 6))
    centre = _pose([1.0, 2.0, 3.0, 0.5, -0.4, 0.3])

    poses = jax.vmap(pose_gaussian.displace, (None, 0))(centre, xi)
    back = jax.vmap(pose_gaussian.coordinates, (None, 0))(centre, poses)

    np.testing.assert_allclose(back, xi, atol=2e-5)


def test_components_at_different_centres_share_one_base_measure(key):
    """E under one Gaussian of another's density over its own is one, at rotations half a radian wide."""
    wide, narrow = _scale(0.3, 0.5), _scale(0.2, 0.3)
    centre, other = _pose([0.0] * 6), _pose([0.1, 0.0, -0.1, 0.3, -0.2, 0.2])
    poses = jax.vmap(pose_gaussian.sample, (0, None, None))(jax.random.split(key, 40_000), centre, wide)

    log_density = jax.vmap(pose_gaussian.log_density, (0, None, None))
    ratio = jnp.exp(log_density(poses, other, narrow) - log_density(poses, centre, wide))

    assert_mean(np.asarray(ratio), 1.0, detectable=0.1)


def test_free_motion_density_is_that_of_its_sampler(key):
    """E under the prior of a Gaussian's density over the prior's is one, for each of its three kinds."""
    history = MotionHistory(_pose([0.0] * 6), _pose([0.03, 0.0, 0.0, 0.0, 0.05, 0.0]), jnp.zeros(3))
    motion = FreeMotion.default()
    poses = jax.jit(jax.vmap(motion.sample, (0, None)))(jax.random.split(key, 60_000), history)
    log_prior = jax.jit(jax.vmap(motion.log_density, (None, 0)))(history, poses)

    for centre, scale in ((history.predicted, _scale(0.01, 0.01)), (history.pose, _scale(0.1, 0.1))):
        log_target = jax.jit(jax.vmap(pose_gaussian.log_density, (0, None, None)))(poses, centre, scale)
        assert_mean(np.exp(np.asarray(log_target - log_prior)), 1.0, detectable=0.15)


def test_free_motion_jump_is_uniform_over_rotations(key):
    """With jumps alone, the density over rotations is 1 / pi^2 wherever the camera turns."""
    motion = FreeMotion(
        jnp.asarray([-jnp.inf, -jnp.inf, 0.0]), _scale(0.1, 0.1), _scale(0.1, 0.1), jnp.asarray(0.5)
    )
    history = MotionHistory(IDENTITY, IDENTITY, jnp.zeros(3))
    rotations = jax.vmap(jaxlie.SO3.sample_uniform)(jax.random.split(key, 20))
    poses = jnp.concatenate([rotations.wxyz, jnp.zeros((20, 3))], axis=-1)

    log_density = jax.jit(jax.vmap(motion.log_density, (None, 0)))(history, poses)

    expected = -2 * np.log(np.pi) - 3 * np.log(0.5 * np.sqrt(2 * np.pi))
    np.testing.assert_allclose(log_density, expected, atol=1e-4)


def test_orbit_density_is_that_of_its_sampler(key):
    """E under the orbit prior of a narrow Gaussian's density over the prior's is one."""
    history = MotionHistory(IDENTITY, IDENTITY, jnp.asarray([0.0, 0.0, 1.0]))
    motion = OrbitMotion(jnp.asarray(0.05), jnp.asarray(30.0), jnp.asarray([0.1, 0.1, 0.2]))
    poses = jax.jit(jax.vmap(motion.sample, (0, None)))(jax.random.split(key, 200_000), history)
    log_prior = jax.jit(jax.vmap(motion.log_density, (None, 0)))(history, poses)

    centre = _pose([0.05, 0.0, 0.0, 0.0, -0.05, 0.0])
    scale = jnp.diag(jnp.asarray([0.05, 0.05, 0.03, 0.06, 0.06, 0.1], jnp.float32))
    log_target = jax.jit(jax.vmap(pose_gaussian.log_density, (0, None, None)))(poses, centre, scale)

    assert_mean(np.exp(np.asarray(log_target - log_prior)), 1.0, detectable=0.2)


def test_orbit_keeps_its_distance_and_looks_at_its_pivot(key):
    """Draws of any direction stay at the radius and aim at the pivot, a half turn included."""
    history = MotionHistory(IDENTITY, IDENTITY, jnp.asarray([0.0, 0.0, 1.2]))
    poses = jax.jit(jax.vmap(OrbitMotion.default().sample, (0, None)))(jax.random.split(key, 2000), history)

    offset = np.asarray(history.pivot)[None] - np.asarray(poses[:, 4:])
    distance = np.linalg.norm(offset, axis=1)
    ahead = jnp.asarray([0.0, 0.0, 1.0])
    axis = np.asarray(jax.vmap(lambda pose: jaxlie.SE3(pose).rotation() @ ahead)(poses))

    np.testing.assert_allclose(distance, 1.2, atol=6 * 0.003)
    assert ((axis * offset).sum(1) / distance > np.cos(0.025 * 6)).all()
    assert (offset[:, 2] < 0).mean() > 0.15
