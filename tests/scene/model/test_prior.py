from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pipeline.benchmarks.cubes import cube_model, floating_draw
from scene.model.contact import relative_box
from scene.model.prior import (
    WeightedTrees,
    contact_densities,
    contact_density,
    contact_of,
    log_floating,
    log_parameters,
    log_pose_given_faces,
    sample_pose,
    supporting_face_probabilities,
)
from scene.model.scene_graph import SceneGraph, all_trees, floating_scene
from shapes.geometry.rotation_densities import LOG_CONTACT_JACOBIAN
from tests.scene.model.test_contact import random_poses
from tests.statistical import assert_mean, assert_uniform


@pytest.mark.parametrize("weight", [1.0, 0.02, 3.0])
@pytest.mark.parametrize("table", [False, True])
@pytest.mark.parametrize("free", [1, 2, 3])
def test_tree_probabilities_sum_to_one(free: int, table: bool, weight: float) -> None:
    """p(G) over every tree, with and without a table; each floating object counts its weight."""
    trees = jnp.asarray(all_trees(free, table=table))
    movable = cube_model(free, table=table).bodies.movable
    present = jnp.ones_like(movable)
    prior = WeightedTrees(jnp.asarray(weight))
    log_p = jax.vmap(lambda parents: prior.log_density(parents, present, movable))(trees)

    np.testing.assert_allclose(jnp.sum(jnp.exp(log_p)), 1.0)
    floating = (trees[:, :free] < 0).sum(axis=1)
    np.testing.assert_allclose(log_p - log_p[0], (floating - floating[0]) * np.log(weight), atol=1e-12)


def test_objects_rest_on_what_points_up() -> None:
    """The parent's face by its normal: uniform without a preference, the top with a strong one."""
    tilted = jnp.array([np.cos(0.1), np.sin(0.1), 0.0, 0.0, 0, 0, 0])
    on_its_side = jnp.array([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0, 0, 0, 0])  # -x points up
    every = jnp.ones(6, bool)
    uniform, upward = (cube_model(2, upward_concentration=kappa).prior for kappa in (0.0, 10.0))

    np.testing.assert_allclose(supporting_face_probabilities(uniform, every, tilted), 1 / 6)
    shares = supporting_face_probabilities(upward, every, tilted)
    normals = np.array([0, 0, -np.sin(0.2), np.sin(0.2), -np.cos(0.2), np.cos(0.2)])
    np.testing.assert_allclose(shares, np.exp(10 * normals) / np.exp(10 * normals).sum())
    assert int(jnp.argmax(supporting_face_probabilities(upward, every, on_its_side))) == 0
    top_only = jnp.arange(6) == 5
    np.testing.assert_allclose(supporting_face_probabilities(upward, top_only, on_its_side), top_only)


def test_a_strong_preference_of_a_thing_on_its_corner_has_a_face() -> None:
    """Three normals point up by 0.58: of single precision, exp(1000 (0.58 - 1)) is zero."""
    half = 0.5 * np.arccos(np.sqrt(1 / 3))
    turn = np.array([np.cos(half), np.sin(half) * np.sqrt(0.5), -np.sin(half) * np.sqrt(0.5), 0.0])
    steep = cube_model(2, upward_concentration=1000.0).prior
    prior = replace(steep, upward_concentration=jnp.float32(1000.0))

    shares = supporting_face_probabilities(
        prior, jnp.ones(6, bool), jnp.asarray([*turn, 0, 0, 0], jnp.float32)
    )

    assert np.sort(np.asarray(shares))[:3].max() < 1e-6
    np.testing.assert_allclose(shares.sum(), 1.0, rtol=1e-5)


def test_contact_table_is_the_contact_density(key: jax.Array) -> None:
    """The table of all parents and faces has the density of each contact in each place."""
    model = cube_model(3, table=True, upward_concentration=2.0)
    bodies = model.bodies
    child = 1

    def one(poses: jax.Array, parent: jax.Array, parent_face: jax.Array, child_face: jax.Array) -> jax.Array:
        return contact_density(
            model.prior,
            relative_box(poses[parent], poses[child]),
            bodies.half_extents_m[parent],
            supporting_face_probabilities(model.prior, bodies.supporting_faces[parent], poses[parent]),
            bodies.half_extents_m[child],
            parent_face,
            child_face,
        )

    grid = jnp.meshgrid(jnp.arange(4), jnp.arange(6), jnp.arange(6), indexing="ij")
    of_all = jax.jit(jax.vmap(one, (None, 0, 0, 0)))
    others, met = np.array([0, 2, 3]), 0
    for poses in (random_poses(one_key, 4) for one_key in jax.random.split(key, 4)):
        expected = of_all(poses, *[axis.ravel() for axis in grid]).reshape(4, 6, 6)[others]
        actual = jax.jit(contact_densities)(model.prior, bodies, poses, jnp.array(child))[others]
        np.testing.assert_allclose(actual, expected, rtol=1e-12)
        met += int((expected > 0).sum())
    assert met > 20


def test_contact_measure_is_eight_times_the_pose_measure(key: jax.Array) -> None:
    """Over floating poses in a cuboid round the parent, E[sum 8 p_contact / p_floating] = 1.

    kappa = 10; with 8 and 1/8 swapped, or left out, it is 1/64 or 1/8. So it is of poses given the parent's
    top face, whose probability is 0.64, and each of the child's.
    """
    model = cube_model(2, upward_concentration=2.0)
    half = jnp.full(3, 4.0)
    wide = replace(
        model.prior,
        low_m=-half,
        high_m=half,
        contact_sigma_m=jnp.array(0.3),
        contact_concentration=jnp.array(10.0),
    )
    parent = jnp.array([1.0, 0, 0, 0, 0, 0, 0])

    def ratio(uniforms: jax.Array) -> jax.Array:
        child = sample_pose(
            uniforms, wide, model.bodies, floating_scene(jnp.stack([parent, parent])), jnp.array(1)
        )
        poses = jnp.stack([parent, child])
        contacts = (
            jnp.exp(LOG_CONTACT_JACOBIAN) * contact_densities(wide, model.bodies, poses, jnp.array(1))[0]
        )

        def given(child_face: jax.Array) -> jax.Array:
            scene = SceneGraph(
                parents=jnp.array([-1, 0]),
                child_faces=jnp.stack([jnp.array(0), child_face]),
                parent_faces=jnp.array([0, 5]),
                poses=poses,
                present=jnp.ones(2, bool),
            )
            return jnp.exp(log_pose_given_faces(wide, model.bodies, scene, jnp.array(1)))

        given_top = jax.vmap(given)(jnp.arange(6))
        densities = jnp.stack([jnp.sum(contacts), jnp.mean(given_top)])
        return densities / jnp.exp(log_floating(wide, child[4:]))

    ratios = jax.lax.map(ratio, jax.random.uniform(key, (400_000, 9)), batch_size=20_000)

    assert_mean(ratios, 1.0, detectable=0.25)


def test_prior_samples_have_the_chart_of_their_density(key: jax.Array) -> None:
    """Contacts drawn from the prior: each coordinate, by its own distribution function, is uniform."""
    model = cube_model(2)
    scene_key, draw_key = jax.random.split(key)
    scene = floating_draw(scene_key, model)
    scene = SceneGraph(jnp.array([-1, 0]), jnp.array([0, 2]), jnp.array([0, 3]), scene.poses, scene.present)

    def contact(uniforms: jax.Array) -> jax.Array:
        pose = sample_pose(uniforms, model.prior, model.bodies, scene, jnp.array(1))
        there = SceneGraph(
            scene.parents, scene.child_faces, scene.parent_faces, scene.poses.at[1].set(pose), scene.present
        )
        drawn = contact_of(model.bodies, there, jnp.array(1))
        azimuth = jnp.arctan2(drawn.eta[1], drawn.eta[0])
        coordinates = jnp.array([drawn.offset_m[0], drawn.offset_m[1], drawn.offset_m[2], azimuth, drawn.phi])
        log_p = log_parameters(model.prior, model.bodies, there, jnp.array(1))
        return jnp.append(coordinates, log_p)

    draws = jax.jit(jax.vmap(contact))(jax.random.uniform(draw_key, (20_000, 9)))

    assert_uniform(draws[:, 0], low=-0.5, high=0.5)
    assert_uniform(draws[:, 1], low=-0.5, high=0.5)
    norm = jax.scipy.stats.norm
    assert_uniform(0.9 * norm.cdf(draws[:, 2] / 0.5) + 0.1 * norm.cdf(draws[:, 2] / 0.7))
    assert_uniform(draws[:, 3], low=-np.pi, high=np.pi)
    assert_uniform(draws[:, 4], low=0, high=2 * np.pi)
    assert np.isfinite(draws[:, 5]).all()
