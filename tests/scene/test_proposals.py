"""What chains are offered, and what they learn in their burn-in."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import trimesh

from scene import pose_mixture
from scene.adaptation import adapted
from scene.pose_mixture import PoseMixture
from scene.proposals import own_components, round_axis, spin
from scene.scene_object import scene_object

MEAN = np.array([0.8, 0.36, 0.48, 0.0, 0.1, -0.2, 0.5])


@pytest.mark.parametrize(
    ("mesh", "axis"),
    [
        (trimesh.creation.cylinder(0.03, 0.1), 2),
        (trimesh.creation.cylinder(0.03, 0.1, transform=np.eye(4)[[1, 2, 0, 3]]), 1),
        (trimesh.creation.box((0.06, 0.06, 0.1)), -1),
    ],
)
def test_round_objects_are_told_by_their_normals(mesh: trimesh.Trimesh, axis: int) -> None:
    """A cylinder is round about its own axis, a square box is not."""
    assert round_axis(scene_object("it", mesh.vertices, mesh.faces)) == axis


def covariance(seed: int) -> jax.Array:
    """A strongly correlated one, of millimetres and hundredths of a radian."""
    factor = np.random.default_rng(seed).normal(size=(6, 6)) * np.repeat([0.001, 0.01], 3)[:, None]
    return jnp.asarray(factor @ factor.T + 1e-8 * np.eye(6))


def samples(key: jax.Array, mixture: PoseMixture, count: int) -> jax.Array:
    """Poses (count, 7)."""
    uniform_key, normal_key = jax.random.split(key)
    uniforms, normals = jax.random.uniform(uniform_key, (count,)), jax.random.normal(normal_key, (count, 6))
    return jax.vmap(pose_mixture.sample, in_axes=(0, 0, None))(uniforms, normals, mixture)


def test_a_round_objects_mixture_looks_the_same_from_all_sides(key: jax.Array, seed: int) -> None:
    """Its density changes little with the spin, though offset and tilt are correlated."""
    own = PoseMixture.build(*own_components(jnp.asarray(MEAN), covariance(seed), jnp.asarray(2)))
    poses = samples(key, own, 200)

    def turned(pose: jax.Array, angle: jax.Array) -> jax.Array:
        rotation = jaxlie.SO3(pose[:4]) @ spin(jnp.asarray(2), angle)
        return jnp.concatenate([rotation.wxyz, pose[4:]])

    angles = jnp.linspace(0, 2 * jnp.pi, 33)
    log_densities = jax.vmap(
        lambda pose: jax.vmap(lambda angle: pose_mixture.log_density(own, turned(pose, angle)))(angles)
    )(poses)

    ranges = np.ptp(np.asarray(log_densities), axis=1)
    assert np.median(ranges) < 0.6
    assert np.abs(log_densities[:, 8] - log_densities[:, 0]).max() < 1e-6  # a quarter of the circle


@pytest.mark.parametrize(("axis", "nats"), [(-1, 0.15), (2, 0.5)])  # a component's tilt does not turn in it
def test_the_burn_in_teaches_mean_and_covariance(key: jax.Array, seed: int, axis: int, nats: float) -> None:
    """States drawn from the components give them back, for round objects from all around the circle."""
    true = own_components(jnp.asarray(MEAN), covariance(seed), jnp.asarray(axis))
    narrow = true[0].at[8:].set(-jnp.inf)
    drawn = PoseMixture.build(narrow, *true[1:])
    states = samples(key, drawn, 4000)
    far = jnp.asarray(MEAN).at[4:].add(0.1)
    first = PoseMixture.build(
        true[0], jnp.broadcast_to(far, (12, 7)), 1e-4 * jnp.broadcast_to(jnp.eye(6), (12, 6, 6))
    )
    first = jax.tree.map(lambda leaf: leaf[None], first)

    taught = adapted(first, jnp.asarray([axis]), states[:, None], jnp.arange(4000.0)).of(jnp.asarray(0))

    expected = PoseMixture.build(*true)
    log_true = jax.vmap(lambda pose: pose_mixture.log_density(expected, pose))(states[:400])
    log_taught = jax.vmap(lambda pose: pose_mixture.log_density(taught, pose))(states[:400])
    assert float(jnp.median(jnp.abs(log_taught - log_true))) < nats
