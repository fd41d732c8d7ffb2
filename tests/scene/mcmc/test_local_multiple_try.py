"""Steps of near candidates: symmetric, so that no density of theirs enters the choice."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from pipeline.benchmarks.cubes import cube_kernel, cube_model, start_chains
from scene.mcmc.local_multiple_try import take_steps
from scene.mcmc.random_variates import Variates
from scene.mcmc.symmetry_arrays import SpinLines

LINE = SpinLines(jnp.array([0.48, 0.6, -0.64]), jnp.array([0.1, -0.2, 0.3]), jnp.array(True))
NO_LINE = SpinLines(jnp.zeros(3), jnp.zeros(3), jnp.array(False))


def a_pose(key: jax.Array) -> jax.Array:
    """Anywhere (7,)."""
    turn_key, place_key = jax.random.split(key)
    return jnp.concatenate([jaxlie.SO3.sample_uniform(turn_key).wxyz, jax.random.normal(place_key, (3,))])


@pytest.mark.parametrize("line", [LINE, NO_LINE], ids=["line", "none"])
def test_a_step_and_its_opposite_lead_back(key: jax.Array, line: SpinLines) -> None:
    """To 1e-12, however long the step is."""
    pose_key, step_key = jax.random.split(key)
    pose, step = a_pose(pose_key), 2 * jax.random.normal(step_key, (7,))

    there = take_steps(line, pose, step)
    back = take_steps(line, there, -step)

    assert float(jnp.linalg.norm(there - pose)) > 0.1
    sign = jnp.where(jnp.arange(7) < 4, jnp.sign(back[:4] @ pose[:4]), 1.0)
    np.testing.assert_allclose(sign * back, pose, atol=1e-12)


@pytest.mark.parametrize("line", [LINE, NO_LINE], ids=["line", "none"])
def test_a_step_preserves_volume(key: jax.Array, line: SpinLines) -> None:
    """Of rotations by Haar's measure and places: the Jacobian between tangents is 1 to 1e-10."""
    pose_key, step_key = jax.random.split(key)
    pose, step = a_pose(pose_key), jax.random.normal(step_key, (7,))
    there = take_steps(line, pose, step)

    def tangent(xi: jax.Array) -> jax.Array:
        turned = jaxlie.SO3(pose[:4]) @ jaxlie.SO3.exp(xi[3:])
        moved = take_steps(line, jnp.concatenate([turned.wxyz, pose[4:] + xi[:3]]), step)
        turn = jaxlie.SO3(there[:4]).inverse() @ jaxlie.SO3(moved[:4])
        return jnp.concatenate([moved[4:] - there[4:], turn.log()])

    jacobian = jax.jacfwd(tangent)(jnp.zeros(6))
    assert abs(float(jnp.linalg.det(jacobian))) == pytest.approx(1, abs=1e-10)


def test_a_spin_leaves_the_line_in_place(key: jax.Array) -> None:
    """Both points of it that are asked, while what is beside it moves."""
    pose = a_pose(key)
    there = take_steps(LINE, pose, jnp.zeros(7).at[6].set(0.9))

    def at(point: jax.Array, pose: jax.Array) -> jax.Array:
        return jaxlie.SO3(pose[:4]).as_matrix() @ point + pose[4:]

    first = LINE.points_m.astype(jnp.float64)  # single precision would put the sum off the line
    for point in (first, first + LINE.directions):
        np.testing.assert_allclose(at(point, pose), at(point, there), atol=1e-12)
    assert float(jnp.linalg.norm(at(jnp.zeros(3), pose) - at(jnp.zeros(3), there))) > 0.1


def test_poses_without_an_edge_are_out_of_use(key: jax.Array) -> None:
    """Outside the cuboid of floating objects and beside the table: the others keep their weights."""
    model = cube_model(1, table=True)
    move = cube_kernel(2, candidates=4).candidates[1]
    start_key, dice_key = jax.random.split(key)
    state = jax.tree.map(lambda leaf: leaf[0], start_chains(start_key, model, 1))

    def offered(key: jax.Array) -> jax.Array:
        dice = Variates.draw(key, (), move.uniforms, move.normals, state.log_prior.dtype)
        return move.propose(model, dice, state).log_offered

    log_offered = np.asarray(jax.jit(jax.vmap(offered))(jax.random.split(dice_key, 256)))
    assert not np.isnan(log_offered).any()
    assert np.isfinite(log_offered[:, 0]).all()
    assert 0 < np.isposinf(log_offered[:, 1:]).mean() < 0.9
