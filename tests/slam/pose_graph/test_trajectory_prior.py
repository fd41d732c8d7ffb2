"""The prior of whole maps is the sum of the filter's own steps, and bends as they do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapes.geometry import pose_gaussian
from shapes.geometry.poses import single_precision_poses
from slam.filter.motion import FreeMotion, MotionHistory, OrbitMotion
from slam.map_hypotheses.circular_paths import repeat_step
from slam.pose_graph.trajectory_prior import TrajectoryPrior
from slam.registration.pose_grids import orbit_steps
from tests.statistical import assert_mean

PIVOT = np.asarray([0.0, 0.0, 1.5])
AIM_M = 0.0375
SIGMA = np.asarray([AIM_M, AIM_M, 0.003])
EVEN = (0, 10, 20, 30, 40)
STEP = orbit_steps(np.asarray([1.5]))[62]


def test_steps_add_up() -> None:
    """Against the parts, at times that are not even."""
    motion, poses = FreeMotion.default(), repeat_step(STEP, 4)
    first, second, third, fourth = single_precision_poses(poses)
    pivot = jnp.asarray(PIVOT, jnp.float32)
    expected = motion.log_density(MotionHistory(first, first, pivot), second)
    for before, last, pose, ratio in ((first, second, third, 2.0), (second, third, fourth, 0.5)):
        predicted = pose_gaussian.displace(last, ratio * pose_gaussian.coordinates(before, last))
        expected += motion.log_density(MotionHistory(last, predicted, pivot), pose)

    found = TrajectoryPrior(motion, PIVOT, SIGMA, (0, 10, 30, 40)).log_density(poses)

    assert found == pytest.approx(float(expected), rel=1e-4)


@pytest.mark.parametrize("motion", [FreeMotion.default(), OrbitMotion.default()])
def test_a_joint_term_is_the_slope_of_the_density(motion: FreeMotion | OrbitMotion) -> None:
    """Differences of the density over 2 mm and 2 mrad each way, near an even circle, within a twentieth."""
    rng = np.random.default_rng(3)
    prior = TrajectoryPrior(motion, PIVOT, SIGMA, EVEN)
    poses = _displaced(repeat_step(STEP, 5), 0.01 * rng.normal(size=(5, 6)))
    term = prior.bent(poses)

    for direction in rng.normal(size=(6, 5, 6)):
        direction[0] = 0.0
        rise, fall = (prior.log_density(_displaced(poses, sign * 0.002 * direction)) for sign in (1, -1))
        slope = -(rise - fall) / 0.004
        size = np.sqrt(direction.ravel() @ term.precision @ direction.ravel())
        assert slope == pytest.approx(term.gradient @ direction.ravel(), abs=0.05 * size + 2.0)


def test_residuals_bend_as_the_density_does() -> None:
    """Gradient and curvature of the free prior against autodiff, next to where constant velocity leads."""
    motion, here = FreeMotion.default(), jnp.asarray(single_precision_poses(STEP))
    history = MotionHistory(
        jnp.asarray(single_precision_poses(np.eye(4))), here, jnp.asarray(PIVOT, jnp.float32)
    )
    xi = jnp.asarray([0.01, -0.02, 0.0, 0.005, 0.01, -0.01])

    def at(xi: jax.Array) -> jax.Array:
        return pose_gaussian.displace(here, xi)

    residual = motion.expected_residual(history, at(xi))
    jacobian = jax.jit(jax.jacfwd(lambda xi: motion.expected_residual(history, at(xi))))(xi)
    slope = jax.jit(jax.grad(lambda xi: -motion.log_density(history, at(xi))))(xi)
    bend = jax.jit(jax.hessian(lambda xi: -motion.log_density(history, at(xi))))(xi)

    np.testing.assert_allclose(residual @ jacobian, slope, atol=0.02)
    np.testing.assert_allclose(jacobian.T @ jacobian, bend, atol=25.0)


def test_the_pivot_is_integrated_out(key: jax.Array) -> None:
    """Against the mean of the density at pivots drawn from their prior, for two cameras."""
    prior = TrajectoryPrior(OrbitMotion.default(), PIVOT, SIGMA, EVEN[:2])
    poses = repeat_step(STEP, 2)
    first, second = single_precision_poses(poses)
    pivots = jnp.asarray(PIVOT + SIGMA * np.asarray(jax.random.normal(key, (20_000, 3))), jnp.float32)

    def density(pivot: jax.Array) -> jax.Array:
        return jnp.exp(prior.motion.log_density(MotionHistory(first, first, pivot), second))

    found = np.exp(prior.log_density(poses))

    assert_mean(np.asarray(jax.jit(jax.vmap(density))(pivots)) / found, 1.0, detectable=0.3)


def test_an_orbit_keeps_to_its_circle() -> None:
    """Ten centimetres off the known radius cost dozens of nats, an unsure aim of the first camera few."""
    prior = TrajectoryPrior(OrbitMotion.default(), PIVOT, SIGMA, EVEN)
    right, wide = (repeat_step(orbit_steps(np.asarray([radius]))[62], 5) for radius in (1.5, 1.6))
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.0, 0.01, 0.0]).as_matrix()
    askew = np.linalg.inv(turn) @ right
    askew[0] = np.eye(4)

    assert prior.log_density(right) > prior.log_density(wide) + 30.0
    assert prior.log_density(right) < prior.log_density(askew) + 3.0


def _displaced(poses: np.ndarray, xi: np.ndarray) -> np.ndarray:
    moved = poses.copy()
    moved[:, :3, 3] += np.einsum("nij,nj->ni", poses[:, :3, :3], xi[:, :3])
    moved[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(xi[:, 3:]).as_matrix()
    return moved
