"""The joint choice of poses from pools, against enumeration."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from scene.search.assignment import PoseLayers, improve_pairs, log_conditional, log_density_of_choice
from scene.search.support_table import SupportTable


def _layers(objects: int, poses: int, pixels: int, seed: int = 0) -> PoseLayers:
    """Random layers; the last pose of each pool shows nothing."""
    rng = np.random.default_rng(seed)
    depth = np.where(rng.random((objects, poses, pixels)) < 0.6, rng.random((objects, poses, pixels)), np.inf)
    depth[:, -1] = np.inf
    alone = rng.standard_normal((objects, poses))
    alone[:, -1] = 0.0
    return PoseLayers(
        depth_m=jnp.asarray(depth, jnp.float32),
        log_density=jnp.asarray(rng.standard_normal((objects, poses, pixels)), jnp.float32),
        log_alone=jnp.asarray(alone, jnp.float32),
        rests=_rests(rng, objects, poses),
        rest_m=jnp.asarray(_rest(rng, pixels), jnp.float32),
        rest_log_density=jnp.asarray(rng.standard_normal(pixels), jnp.float32),
    )


def _rests(rng: np.random.Generator, objects: int, poses: int) -> SupportTable:
    """Random ones; of the poses a third is over another's, the absent object over and under none."""
    alone = -rng.exponential(2.0, (objects, poses))
    on = np.where(
        rng.random((objects, poses, objects, poses)) < 0.33,
        -rng.exponential(0.5, alone.shape + alone.shape),
        -np.inf,
    )
    alone[:, -1] = 0
    on[:, -1] = on[..., -1] = -np.inf
    on[np.arange(objects), :, np.arange(objects)] = -np.inf
    return SupportTable(jnp.asarray(alone, jnp.float32), jnp.asarray(on, jnp.float32))


def _rest(rng: np.random.Generator, pixels: int) -> np.ndarray:
    """Depth of the background, which a third of the pixels lack."""
    return np.where(rng.random(pixels) < 0.33, np.inf, rng.uniform(0.5, 1.5, pixels))


def test_pixels_show_what_is_nearest() -> None:
    """One pixel after the other by comparison, also where no object and no background is."""
    given = _layers(3, 4, 40)
    layers = jax.device_get(given)  # pixels of device arrays are slow to read
    depth_m, log_density = layers.depth_m, layers.log_density
    for choice in itertools.product(range(4), repeat=3):
        expected = sum(layers.log_alone[one, pose] for one, pose in enumerate(choice))
        expected += sum(
            max(
                float(layers.rests.log_alone[one, pose]),
                *(float(layers.rests.log_on[one, pose, other, choice[other]]) for other in range(3)),
            )
            for one, pose in enumerate(choice)
        )
        for pixel in range(40):
            nearest, shown = float(layers.rest_m[pixel]), float(layers.rest_log_density[pixel])
            for one, pose in enumerate(choice):
                if depth_m[one, pose, pixel] < nearest:
                    nearest, shown = depth_m[one, pose, pixel], log_density[one, pose, pixel]
            expected += shown
        np.testing.assert_allclose(log_density_of_choice(given, jnp.array(choice)), expected, atol=1e-4)


def test_conditionals_are_slices_of_the_joint() -> None:
    """Entries of a conditional differ as the densities of the scenes with those poses do."""
    layers = _layers(3, 4, 20)
    choice = jnp.array([1, 0, 2])
    for one in range(3):
        scenes = [choice.at[one].set(pose) for pose in range(4)]
        joint = [float(log_density_of_choice(layers, scene)) for scene in scenes]
        conditional = np.asarray(log_conditional(layers, choice, jnp.asarray(one)))
        np.testing.assert_allclose(conditional - conditional[0], np.array(joint) - joint[0], atol=1e-4)


def test_two_objects_get_their_best_joint_poses() -> None:
    """With every pose a candidate, the pair is the best of all; from any start with one of them."""
    layers = _layers(2, 6, 30)
    scenes = jnp.asarray(list(itertools.product(range(6), repeat=2)))
    densities = jax.vmap(lambda scene: log_density_of_choice(layers, scene))(scenes)
    best = scenes[jnp.argmax(densities)]
    for start in scenes[:-1:7]:
        np.testing.assert_array_equal(improve_pairs(layers, start, 8), best)


def test_pairs_never_make_a_scene_worse() -> None:
    """Few candidates, four objects."""
    layers = _layers(4, 9, 40, seed=1)
    for seed in range(5):
        start = jax.random.randint(jax.random.key(seed), (4,), 0, 9)
        before, after = (
            float(log_density_of_choice(layers, choice))
            for choice in (start, improve_pairs(layers, start, 4))
        )
        assert after >= before - 1e-4


def test_one_object_has_no_pair() -> None:
    """Nothing to improve: the choice is returned as it is."""
    layers = _layers(1, 5, 20)
    for start in range(5):
        np.testing.assert_array_equal(improve_pairs(layers, jnp.array([start]), 32), [start])


def test_pools_may_be_smaller_than_the_candidates() -> None:
    """Then every pose is one, and the pair is the best of all."""
    layers = _layers(2, 4, 30, seed=2)
    scenes = jnp.asarray(list(itertools.product(range(4), repeat=2)))
    densities = jax.vmap(lambda scene: log_density_of_choice(layers, scene))(scenes)
    np.testing.assert_array_equal(improve_pairs(layers, scenes[5], 32), scenes[jnp.argmax(densities)])
