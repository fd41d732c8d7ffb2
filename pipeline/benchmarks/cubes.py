"""The special configuration: cubes of 1 m in (1.5 m)^3, where chains change the graph all the time."""

from functools import partial

import jax
import jax.numpy as jnp

from scene.mcmc.edges import EdgeMove
from scene.mcmc.kernel import Kernel, scene_kernel
from scene.mcmc.pose_mixture import PoseMixture
from scene.mcmc.symmetry_arrays import SpinLines, Symmetries
from scene.model.posterior import ChainState, Likelihood, NoData, SceneModel, start_chain
from scene.model.prior import POSE_UNIFORMS, PosePrior, StructurePrior, WeightedTrees, sample_pose
from scene.model.scene_graph import Bodies, SceneGraph, floating_scene, tree_code


def cube_model(
    free: int,
    *,
    table: bool = False,
    structure: StructurePrior | None = None,
    likelihood: Likelihood | None = None,
    slack_share: float = 0.1,
    upward_concentration: float = 0.0,
) -> SceneModel:
    """Cubes, with a fixed one whose top alone supports as the table."""
    count = free + table
    movable = jnp.arange(count) < free
    supporting = movable[:, None] | (jnp.arange(6) == 5)[None]
    bodies = Bodies(jnp.full((count, 3), 0.5), movable, supporting)
    half = jnp.full(3, 0.75)
    prior = PosePrior(
        low_m=-half,
        high_m=half,
        contact_sigma_m=jnp.array(0.5),
        loose_sigma_m=jnp.array(0.7),
        contact_concentration=jnp.array(1.0),
        slack_share=jnp.array(slack_share),
        upward_concentration=jnp.array(upward_concentration),
    )
    return SceneModel(bodies, prior, structure or WeightedTrees.uniform(), likelihood or NoData())


def cube_kernel(
    count: int,
    *,
    prior_share: float = 0.6,
    candidates: int = 2,
    repeats: int = 4,
) -> Kernel:
    """The production kernel, with walks as wide as the cubes."""
    centres = jnp.tile(jnp.array([1.0, 0, 0, 0, 0, 0, 0]), (count, 1, 1))
    covariances = jnp.tile(jnp.diag(jnp.array([0.3, 0.3, 0.3, 0.8, 0.8, 0.8]) ** 2), (count, 1, 1, 1))
    mixture = PoseMixture.build(jnp.zeros((count, 1)), centres, covariances)
    scale = jnp.full(count, 0.5)
    return scene_kernel(
        mixture,
        prior_share=prior_share,
        translation_m=scale,
        rotation_rad=2 * scale,
        lines=SpinLines.of([], count),
        symmetries=Symmetries.of([], count),
        candidates=candidates,
        repeats=repeats,
        structure=EdgeMove(),
    )


def floating_draw(key: jax.Array, model: SceneModel) -> SceneGraph:
    """All objects floating, drawn from the prior; the table at the origin."""
    movable = model.bodies.movable
    count = len(movable)
    rest = jnp.tile(jnp.array([1.0, 0, 0, 0, 0, 0, 0]), (count, 1))
    draw = partial(
        sample_pose, prior=model.prior, bodies=model.bodies, scene=floating_scene(rest), child=jnp.array(0)
    )
    poses = jax.vmap(draw)(jax.random.uniform(key, (count, POSE_UNIFORMS)))
    return floating_scene(jnp.where(movable[:, None], poses, rest))


@partial(jax.jit, static_argnames="chains")
def start_chains(key: jax.Array, model: SceneModel, chains: int) -> ChainState:
    """Independent chains from floating draws."""
    scene_key, chain_key = jax.random.split(key)
    scenes = jax.vmap(partial(floating_draw, model=model))(jax.random.split(scene_key, chains))
    return jax.vmap(lambda key, scene: start_chain(key, model, scene))(
        jax.random.split(chain_key, chains), scenes
    )


def code_of(state: ChainState) -> jax.Array:
    """The tree of a state."""
    return tree_code(state.scene.parents)
