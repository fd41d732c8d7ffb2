"""Contacts of an object that is placed anew."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.benchmarks.cubes import cube_model, start_chains
from scene.mcmc.face_relabelling import at_reference, placed
from scene.model.scene_graph import SceneGraph
from scene.objects.orientations import cube_rotations
from tests.scene.model.test_contact import random_poses


def stack() -> SceneGraph:
    """A cube on a cube on a table, the second one the wrong way up and slightly askew."""
    up = np.array([[0.02, 0.99, 0.03, 0.01], [0.99, 0.01, 0.02, 0.03], [1.0, 0, 0, 0]])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    heights = np.array([[0.0, 0, 1.0], [0.1, 0.1, 2.0], [0, 0, 0]])
    return SceneGraph(
        parents=jnp.array([2, 0, -1]),
        child_faces=jnp.array([5, 4, 0]),
        parent_faces=jnp.array([5, 4, 0]),
        poses=jnp.asarray(np.concatenate([up, heights], axis=1)),
        present=jnp.ones(3, bool),
    )


def test_a_turned_cube_rests_as_it_did(key: jax.Array) -> None:
    """All 24 rotations of the lower cube onto itself leave the prior as it is, from any reference."""
    model = cube_model(2, table=True, upward_concentration=2.0)
    model = replace(model, prior=replace(model.prior, contact_concentration=jnp.array(500.0)))
    scene, chosen = stack(), jnp.array(0)
    turns = jnp.asarray(Rotation.from_matrix(cube_rotations()).as_quat()[:, [3, 0, 1, 2]])
    reference = random_poses(key, 1)[0]
    before = Rotation.from_quat(np.roll(scene.poses[0, :4], -1))
    turned = before * Rotation.from_quat(np.roll(turns, -1, axis=1))
    wxyz = jnp.asarray(turned.as_quat()[:, [3, 0, 1, 2]])
    poses = jnp.concatenate([wxyz, jnp.broadcast_to(scene.poses[0, 4:], (24, 3))], axis=1)

    scenes = jax.jit(jax.vmap(partial(placed, at_reference(scene, chosen, reference), chosen)))(poses)

    log_prior = jax.jit(model.log_prior)
    expected = float(log_prior(scene))
    assert np.isfinite(expected)
    np.testing.assert_allclose(jax.vmap(log_prior)(scenes), expected, atol=1e-6)
    renamed = np.stack([scenes.child_faces[:, 0], scenes.parent_faces[:, 1]], axis=1)
    assert (np.bincount(renamed[:, 0]) == 4).all()  # each face is down in four of them
    assert (renamed[:, 0] == renamed[:, 1] ^ 1).all()  # and the opposite one up


def test_names_of_faces_compose(key: jax.Array) -> None:
    """From one pose to another by way of a third, and back: names depend on the pose alone."""
    start_key, child_key, parent_key, pose_key = jax.random.split(key, 4)
    scenes = start_chains(start_key, cube_model(3), 64).scene
    scenes = replace(
        scenes,
        parents=jnp.broadcast_to(jnp.array([1, -1, 1]), (64, 3)),
        child_faces=jax.random.randint(child_key, (64, 3), 0, 6).at[:, 1].set(0),
        parent_faces=jax.random.randint(parent_key, (64, 3), 0, 6).at[:, 1].set(0),
    )
    reference, *poses = random_poses(pose_key, 129)
    first, second = jnp.stack(poses).reshape(2, 64, 7)
    for chosen in (0, 1):
        number = jnp.array(chosen)
        at = jax.jit(
            jax.vmap(
                lambda scene, pose, number=number: placed(
                    at_reference(scene, number, reference), number, pose
                )
            )
        )
        direct = at(scenes, second)
        for other in (at(at(scenes, first), second), at(at(direct, first), second)):
            for one, same in zip(jax.tree.leaves(other), jax.tree.leaves(direct), strict=True):
                np.testing.assert_array_equal(one, same)
        back = at(direct, scenes.poses[:, chosen])
        np.testing.assert_array_equal(back.child_faces, scenes.child_faces)
        np.testing.assert_array_equal(back.parent_faces, scenes.parent_faces)
        assert (direct.child_faces != scenes.child_faces).any() == (chosen == 0)
        assert (direct.parent_faces != scenes.parent_faces).any() == (chosen == 1)
