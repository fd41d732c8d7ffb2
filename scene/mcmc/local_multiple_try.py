"""Multiple-try moves of one object to one of several poses near its present one.

The likelihood of a pose is rugged: a pixel at an outline that changes sides costs some nats, several times
a millimetre. Most single proposals are refused; of several, one is about as good as the present pose.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp

from scene.mcmc.edges import edge_index, edge_weights, with_edge
from scene.mcmc.face_relabelling import at_reference, placed
from scene.mcmc.involution import CandidateSet
from scene.mcmc.pose_mixture import PoseMixture
from scene.mcmc.random_variates import Variates, draw_index, draw_object
from scene.mcmc.symmetry_arrays import SpinLines, Symmetries, symmetry_angle
from scene.mcmc.walks import normalise
from scene.model.posterior import ChainState, SceneModel
from scene.model.scene_graph import SceneGraph, subtree
from shapes.geometry import quaternions
from shapes.geometry.rotation_densities import LOG_CONTACT_JACOBIAN

SMALLEST, LARGEST = 0.15, 1.2
"""Scales of steps over the standard deviations of the pose, log-uniform between these."""

LEAST_SPIN_RAD, MOST_SPIN_RAD = 0.01, 2.0
"""Standard deviations of spins about an object's line, alike."""

SPIN_SHARE, TURN_SHARE = 0.25, 0.25
"""Of all steps, that spin so, and that make parts of a turn."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LocalMultipleTry:
    """One of K poses round a point near the present one x, each with an edge of its own.

    A point z is drawn round x and K - 1 poses y round z, all by one symmetric step k, and the choice is in
    proportion to pi (Tjelmeland 2004). That step is Gaussian, or Gaussian across the object's line and a spin
    about it of any scale between `LEAST_SPIN_RAD` and `MOST_SPIN_RAD`, or Gaussian and perhaps half or a
    quarter of a turn about a line that leaves the object nearly as it is. The joint density
    pi(x) k(x, z) prod k(z, y), times the chance of the choice, is symmetric in who of the K is the present
    one: as an involution, with the place of the choice as auxiliary variable, h swaps two poses and the
    weight is 1. The choice is Metropolised (`decide`), which leaves the same weights invariant and stays less
    often.

    Where the graph may change, every pose comes with an edge drawn from r(edge | pose) in proportion to
    p(pose | edge) p(edge): of such pairs the choice is in proportion to pi / r, the density of the pose
    summed over its edges. An object that floats beside what it could rest on would otherwise have to cross
    poses that are unlikely under both.

    What rests on the object stays where it is, and contacts keep the faces that point the same way, whatever
    their names (`placed`): the same state in other names, which are one to one at every pose, so that pi
    is as if each pose had its own.

    Attributes:
        mixture: a step has the covariance of its first component.
        lines: about which most of each object is round. Gaussian steps do not spin what is free about its
            line: a scan's little bumps make many narrow modes of a round object's spin.
        symmetries: the lines of parts of a turn.
        count: K.
        grafts: whether edges are drawn with the poses.
    """

    mixture: PoseMixture
    lines: SpinLines
    symmetries: Symmetries
    count: int = field(metadata={"static": True})
    grafts: bool = field(metadata={"static": True})

    @property
    def uniforms(self) -> int:
        """Numbers that a draw takes: object, scale and kind of step, and those of the edges."""
        return 3 + self.grafts * (self.count - 1)

    @property
    def normals(self) -> int:
        """Numbers that a draw takes."""
        return 7 * self.count

    def propose(self, model: SceneModel, dice: Variates, state: ChainState) -> CandidateSet:
        """The scenes, of which one is to be chosen."""
        scene = state.scene
        chosen = draw_object(scene.present & model.bodies.movable, dice.uniform[0])
        turned = at_reference(scene, chosen, self.mixture.centres[chosen, 0])
        line, steps = self._steps(dice.without(1), chosen)
        centre = take_steps(line, scene.poses[chosen], steps[0])
        poses = jax.vmap(partial(take_steps, line, centre))(steps[1:])
        poses = jnp.concatenate([scene.poses[chosen][None], poses])
        scenes = jax.vmap(partial(placed, turned, chosen))(poses)
        log_edges = jnp.zeros(self.count, poses.dtype)
        if self.grafts:
            scenes, log_edges = _with_edges(dice.uniform[3 : self.uniforms], model, scenes, chosen)
        return CandidateSet(scenes, log_edges)

    def _steps(self, dice: Variates, chosen: jax.Array) -> tuple[SpinLines, jax.Array]:
        """The steps (K, 7), the first to the point between, and the line of all their turns."""
        line = self.lines.of_body(chosen)
        size, kind = dice.uniform[:2]
        normal = dice.normal[: self.normals].reshape(self.count, 7)
        scale = SMALLEST * (LARGEST / SMALLEST) ** size
        steps = scale * jnp.sum(self.mixture.choleskys[chosen, 0][None] * normal[:, None, :6], axis=2)
        spins = kind < SPIN_SHARE
        across = spins | line.free
        along = jnp.sum(steps[:, 3:] * line.directions[None], axis=1, keepdims=True) * line.directions[None]
        tilts = steps[:, 3:] - jnp.where(across, along, 0.0)
        tilts = jax.vmap(partial(quaternions.rotate, self.mixture.centres[chosen, 0, :4]))(tilts)
        widest = LEAST_SPIN_RAD * (MOST_SPIN_RAD / LEAST_SPIN_RAD) ** (kind / SPIN_SHARE)
        direction, point, order = self.symmetries.drawn(chosen, (kind - SPIN_SHARE) / TURN_SHARE)
        turns = ~spins & (kind < SPIN_SHARE + TURN_SHARE) & (order > 0)
        spun = jnp.where(spins, widest, 0.0) * normal[:, 6]
        angles = jnp.where(turns, symmetry_angle(order, normal[:, 6]), spun)
        directions, points_m = (
            jnp.where(turns, of_turn, of_spin)
            for of_turn, of_spin in ((direction, line.directions), (point, line.points_m))
        )
        line = SpinLines(directions, points_m, line.free)
        return line, jnp.concatenate([steps[:, :3], tilts, angles[:, None]], axis=1)


def _with_edges(
    uniform: jax.Array, model: SceneModel, scenes: SceneGraph, chosen: jax.Array
) -> tuple[SceneGraph, jax.Array]:
    """The scenes (K, ...), all but the first with edges drawn, and log r (K,) in the states' measure.

    Where a pose has no edge, log r is +inf: it is out of use, and the others stay in it.
    """
    below = subtree(scenes.parents[0], chosen)
    parents = scenes.present[0] & ~below
    floating, contacts = jax.vmap(lambda poses: edge_weights(model, poses, chosen, parents))(scenes.poses)
    weights = jnp.concatenate([floating[:, None], contacts], axis=1)
    present = edge_index(jax.tree.map(lambda leaf: leaf[0], scenes), chosen)
    drawn = jax.vmap(draw_index)(weights[1:], uniform)
    places = jnp.concatenate([present[None].astype(drawn.dtype), drawn])
    each, total = jnp.take_along_axis(weights, places[:, None], axis=1)[:, 0], jnp.sum(weights, axis=1)
    log_jacobian = jnp.where(places > 0, LOG_CONTACT_JACOBIAN, 0.0)
    log_edges = jnp.where(total > 0, jnp.log(each) - jnp.log(total) - log_jacobian, jnp.inf)
    scenes = jax.vmap(lambda scene, place: with_edge(scene, chosen, place))(scenes, places)
    return scenes, log_edges


def take_steps(line: SpinLines, pose: jax.Array, step: jax.Array) -> jax.Array:
    """The pose (7,) after a step (7,): an offset and a rotation vector, and the angle of a spin.

    Offset and rotation are along the world's axes: what the images tell of an object's tilt does not turn
    with a spin of a round object. The point of its line moves by the offset alone.
    """
    turned = quaternions.multiply(quaternions.exp(step[3:6]), pose[:4])
    turned = quaternions.multiply(turned, quaternions.exp(step[6] * line.directions))
    point = pose[4:] + quaternions.rotate(pose[:4], line.points_m) + step[:3]
    return normalise(jnp.concatenate([turned, point - quaternions.rotate(turned, line.points_m)]))
