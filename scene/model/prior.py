"""Prior densities p(G) and p(theta | G) of supplement O, in the one base measure.

A floating pose has density 1/V 1/pi^2 (Lebesgue on R^3 x rotation measure). A contact has a density with
respect to counting measure on the faces x Lebesgue on (a, b, z) x S^2 x S^1. Densities of contacts are
products of sums, so that they are no logarithms before they are whole: those cost most of a table's time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import jax
import jax.numpy as jnp

from scene.model.contact import (
    Contact,
    RelativeBox,
    contact_from_poses,
    face_contact,
    face_half_sizes,
    pose_from_contact,
    relative_box,
    upward_part,
)
from scene.model.scene_graph import ROOT, Bodies, SceneGraph
from shapes.geometry.rotation_densities import (
    LOG_CONTACT_JACOBIAN,
    LOG_ROTATION_MASS,
    hemisphere_direction,
    uniform_rotation,
    von_mises_fisher,
    von_mises_fisher_direction,
)

FLOATING_HEIGHT_M = 0.6
"""Floating objects are up to this far over the table."""

POSE_UNIFORMS = 9
"""Uniform numbers that `sample_pose` takes."""

CHILD_FACES = 6

_CIRCLE = 2 * math.pi

_SQRT_2PI = math.sqrt(2 * math.pi)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PosePrior:
    """Parameters of p(theta | G).

    The volume of the cuboid is the strength of the preference for contact: a floating object pays log V.

    Attributes:
        low_m, high_m: (3,) corners of the cuboid in the world that holds the centres of floating objects.
        contact_sigma_m: standard deviation of the gap z between two faces that meet.
        loose_sigma_m: the same where the surfaces meet elsewhere, as in a bowl or under a handle.
        contact_concentration: kappa of the von Mises-Fisher density of eta about flush contact.
        slack_share: weight of the loose gap in z's density, and of the uniform hemisphere in eta's, for rests
            that are not flush with a face of the bounding box.
        upward_concentration: kappa of the parent's face, p(f') in proportion to exp(kappa n_z) with the
            upward part n_z of its normal: things rest on what points up. 0 is the supplement's uniform f'.
    """

    low_m: jax.Array
    high_m: jax.Array
    contact_sigma_m: jax.Array
    loose_sigma_m: jax.Array
    contact_concentration: jax.Array
    slack_share: jax.Array
    upward_concentration: jax.Array


class GapPrior(Protocol):
    """The parameters of `gap_density`, those of `PosePrior`."""

    @property
    def contact_sigma_m(self) -> jax.Array | float: ...  # noqa: D102

    @property
    def loose_sigma_m(self) -> jax.Array | float: ...  # noqa: D102

    @property
    def slack_share(self) -> jax.Array | float: ...  # noqa: D102


class StructurePrior(Protocol):
    """log p(G), up to one constant that is the same for all trees over the same objects."""

    def log_density(self, parents: jax.Array, present: jax.Array, movable: jax.Array) -> jax.Array:
        """Log p of the tree with these parents (C,), over the present objects."""
        ...

    def log_floating_odds(self) -> jax.Array:
        """Log odds at which moves of the graph propose the root against any other parent."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WeightedTrees:
    """Every floating object counts w, every supported one 1, so that w = 1 is uniform.

    The weights of all trees over N present free objects sum to w (w + N)^(N-1), with the table to
    (w + 1) (w + 1 + N)^(N-1) (Cayley's formula with weights).

    Attributes:
        floating_weight: w, the odds of floating against resting on one given supporter.
    """

    floating_weight: jax.Array

    @classmethod
    def uniform(cls) -> WeightedTrees:
        """The supplement's p(G)."""
        return cls(jnp.ones(()))

    def log_density(self, parents: jax.Array, present: jax.Array, movable: jax.Array) -> jax.Array:
        """Log p(G)."""
        free = jnp.sum(present & movable)
        weight = self.floating_weight
        grounded = weight + jnp.sum(present & ~movable)
        log_sum = jnp.log(grounded) + (free - 1) * jnp.log(grounded + free)
        floating = jnp.sum((parents == ROOT) & present & movable, axis=-1)
        return floating * jnp.log(weight) - jnp.where(free > 0, log_sum, 0.0)

    def log_floating_odds(self) -> jax.Array:
        """Log w, which makes a draw of edges in proportion to the prior."""
        return jnp.log(self.floating_weight)


def log_floating(prior: PosePrior, position_m: jax.Array) -> jax.Array:
    """Log density of a floating pose by its position (..., 3)."""
    lead = (None,) * (position_m.ndim - 1)
    inside = jnp.all((position_m >= prior.low_m[lead]) & (position_m <= prior.high_m[lead]), axis=-1)
    log_volume = jnp.sum(jnp.log(prior.high_m - prior.low_m))
    return jnp.where(inside, -log_volume - LOG_ROTATION_MASS, -jnp.inf)


def contact_density(
    prior: PosePrior,
    box: RelativeBox,
    parent_half_extents_m: jax.Array,
    parent_faces: jax.Array,
    child_half_extents_m: jax.Array,
    parent_face: jax.Array,
    child_face: jax.Array,
) -> jax.Array:
    """Density of one contact, faces included: (a, b) uniform on the parent's face, phi uniform.

    Args:
        prior: parameters.
        box: the child as its parent sees it.
        parent_half_extents_m: (3,).
        parent_faces: (6,) p(f'), `supporting_face_probabilities`.
        child_half_extents_m: (3,).
        parent_face: the parent's face.
        child_face: the child's.
    """
    on_face, gap_m, eta_z = face_contact(
        box, parent_half_extents_m, child_half_extents_m, parent_face, child_face
    )
    in_plane = jnp.arange(3) != parent_face >> 1
    area = jnp.prod(jnp.where(in_plane, 2 * parent_half_extents_m, 1.0))
    faces_and_plane = parent_faces[parent_face] / (area * (CHILD_FACES * _CIRCLE))
    return jnp.where(on_face, faces_and_plane * gap_density(prior, gap_m) * eta_density(prior, eta_z), 0.0)


def supporting_face_probabilities(prior: PosePrior, supporting: jax.Array, pose: jax.Array) -> jax.Array:
    """Probability (..., 6) that each face of an object at poses (..., 7) is the one that carries another.

    Args:
        prior: parameters.
        supporting: (..., 6) bool, faces that can.
        pose: world_from_object; the world's third axis points up.
    """
    up = upward_part(pose[..., :4])
    upward = jnp.stack([-up, up], axis=-1).reshape(supporting.shape)
    highest = jnp.max(upward, axis=-1, keepdims=True, where=supporting, initial=-1.0)
    weights = jnp.where(supporting, jnp.exp(prior.upward_concentration * (upward - highest)), 0.0)
    return weights / jnp.sum(weights, axis=-1, keepdims=True)


def gap_density(prior: GapPrior, gap_m: jax.Array) -> jax.Array:
    """Density of the gap z between two faces: two normals, of mean zero."""
    sigmas = prior.contact_sigma_m, prior.loose_sigma_m
    shares = 1 - prior.slack_share, prior.slack_share
    squared = gap_m * gap_m
    met, loose = (
        share / (_SQRT_2PI * sigma) * jnp.exp(squared * (-0.5 / sigma**2))
        for share, sigma in zip(shares, sigmas, strict=True)
    )
    return met + loose


def eta_density(prior: PosePrior, eta_z: jax.Array) -> jax.Array:
    """Density on S^2 of the direction of contact: von Mises-Fisher plus a uniform hemisphere."""
    flush = (1 - prior.slack_share) * von_mises_fisher(prior.contact_concentration, eta_z)
    return flush + jnp.where(eta_z > 0, prior.slack_share / (2 * jnp.pi), 0.0)


def contact_densities(prior: PosePrior, bodies: Bodies, poses: jax.Array, child: jax.Array) -> jax.Array:
    """Densities (C, f', f) of `child`'s contact parameters, were it on each face of each object."""
    return densities_on(prior, bodies, poses, bodies.half_extents_m[child], poses[child])


def densities_on(
    prior: PosePrior, bodies: Bodies, poses: jax.Array, half_m: jax.Array, pose: jax.Array
) -> jax.Array:
    """Densities (C, f', f) of the contact parameters of a box (3,) at a pose (7,) on each face of bodies.

    `contact_density` over all pairs of faces at once, as arrays (parent, its axis, its side, child's axis,
    child's side); the barriers keep XLA from recomputing an intermediate for each of the 36 pairs.
    """
    half_extents = bodies.half_extents_m
    boxes = jax.vmap(relative_box, in_axes=(0, None))(poses, pose)
    axes, centres = jax.lax.optimization_barrier((boxes.axes, boxes.centre_m))
    sides = jnp.asarray([-1.0, 1.0], poses.dtype)
    face_centres = (
        centres[:, :, None, None] + (axes * half_m[None, None])[..., None] * sides[None, None, None]
    )
    beside = (jnp.abs(face_centres) > half_extents[:, :, None, None]).astype(poses.dtype)
    beside_elsewhere = jnp.sum(beside, axis=1, keepdims=True) - beside
    gaps_m = (
        face_centres[:, :, None] * sides[None, None, :, None, None] - half_extents[:, :, None, None, None]
    )
    eta_opposed, eta_alike, beside_elsewhere = jax.lax.optimization_barrier(
        (eta_density(prior, axes), eta_density(prior, -axes), beside_elsewhere)
    )
    alike = (sides[:, None, None] * sides[None, None, :] > 0)[None, None]
    etas = jnp.where(alike, eta_alike[:, :, None, :, None], eta_opposed[:, :, None, :, None])
    areas = jnp.prod(2 * half_extents, axis=1, keepdims=True) / (2 * half_extents)
    parent_faces = supporting_face_probabilities(prior, bodies.supporting_faces, poses).reshape(-1, 3, 2)
    faces_and_plane = parent_faces / (areas * (CHILD_FACES * _CIRCLE))[..., None]
    density = gap_density(prior, gaps_m) * etas * faces_and_plane[:, :, :, None, None]
    return jnp.where(beside_elsewhere[:, :, None] == 0, density, 0.0).reshape(-1, 6, 6)


def contact_of(bodies: Bodies, scene: SceneGraph, child: jax.Array) -> Contact:
    """The contact parameters of a child under its parent and faces."""
    parent_pose, *ends = _ends(bodies, scene, child)
    return contact_from_poses(parent_pose, scene.poses[child], *ends)


def pose_in_contact(bodies: Bodies, scene: SceneGraph, child: jax.Array, contact: Contact) -> jax.Array:
    """The pose (7,) that a child would have with other contact parameters under its parent and faces."""
    return pose_from_contact(contact, *_ends(bodies, scene, child))


def _ends(bodies: Bodies, scene: SceneGraph, child: jax.Array) -> tuple[jax.Array, ...]:
    """The parent's pose, both half extents and both faces of a child's edge."""
    parent, half_extents = scene.parents[child], bodies.half_extents_m
    faces = scene.parent_faces[child], scene.child_faces[child]
    return scene.poses[parent], half_extents[parent], half_extents[child], *faces


def log_parameters(prior: PosePrior, bodies: Bodies, scene: SceneGraph, child: jax.Array) -> jax.Array:
    """Log p(theta_child | G) of one object's active parameters; the table's are given and count 0."""
    parent = scene.parents[child]
    in_contact = contact_density(
        prior,
        relative_box(scene.poses[parent], scene.poses[child]),
        bodies.half_extents_m[parent],
        _faces_of_parent(prior, bodies, scene, child),
        bodies.half_extents_m[child],
        scene.parent_faces[child],
        scene.child_faces[child],
    )
    floating = log_floating(prior, scene.poses[child, 4:])
    log_density = jnp.where(parent == ROOT, floating, jnp.log(in_contact))
    return jnp.where(scene.present[child] & bodies.movable[child], log_density, 0.0)


def log_pose_given_faces(prior: PosePrior, bodies: Bodies, scene: SceneGraph, child: jax.Array) -> jax.Array:
    """Log p(x | parent, faces) of the child's absolute pose (Lebesgue x rotation measure), as sampled."""
    parent = scene.parents[child]
    log_face = jnp.log(_faces_of_parent(prior, bodies, scene, child)[scene.parent_faces[child]])
    conversion = jnp.where(parent == ROOT, 0.0, LOG_CONTACT_JACOBIAN + math.log(CHILD_FACES) - log_face)
    return log_parameters(prior, bodies, scene, child) + conversion


def _faces_of_parent(prior: PosePrior, bodies: Bodies, scene: SceneGraph, child: jax.Array) -> jax.Array:
    parent = scene.parents[child]
    return supporting_face_probabilities(prior, bodies.supporting_faces[parent], scene.poses[parent])


def log_prior(prior: PosePrior, structure: StructurePrior, bodies: Bodies, scene: SceneGraph) -> jax.Array:
    """Log p(G) p(theta | G) of a whole scene."""
    objects = jnp.arange(len(scene.parents))
    log_poses = jax.vmap(lambda child: log_parameters(prior, bodies, scene, child))(objects)
    return structure.log_density(scene.parents, scene.present, bodies.movable) + jnp.sum(log_poses)


def sample_pose(
    uniforms: jax.Array, prior: PosePrior, bodies: Bodies, scene: SceneGraph, child: jax.Array
) -> jax.Array:
    """Pose (7,) of a child drawn from its prior given its parent and faces, of `POSE_UNIFORMS` numbers."""
    parent = scene.parents[child]
    half_sizes = face_half_sizes(bodies.half_extents_m[parent], scene.parent_faces[child])
    contact = _contact_from_uniforms(prior, half_sizes, uniforms)
    supported = pose_in_contact(bodies, scene, child, contact)
    return jnp.where(parent == ROOT, _floating_from_uniforms(prior, uniforms), supported)


def _floating_from_uniforms(prior: PosePrior, uniforms: jax.Array) -> jax.Array:
    position = prior.low_m + (prior.high_m - prior.low_m) * uniforms[:3]
    return jnp.concatenate([uniform_rotation(uniforms[3:6]), position])


def _contact_from_uniforms(prior: PosePrior, half_sizes_m: jax.Array, uniforms: jax.Array) -> Contact:
    plane = half_sizes_m * (2 * uniforms[:2] - 1)
    normal = jnp.sqrt(-2 * jnp.log1p(-uniforms[2])) * jnp.cos(2 * jnp.pi * uniforms[3])  # Box-Muller
    eta = jnp.where(
        uniforms[4] < prior.slack_share,
        hemisphere_direction(uniforms[5:7]),
        von_mises_fisher_direction(prior.contact_concentration, uniforms[5:7]),
    )
    sigma_m = jnp.where(uniforms[8] < prior.slack_share, prior.loose_sigma_m, prior.contact_sigma_m)
    offset = jnp.concatenate([plane, (sigma_m * normal)[None]])
    return Contact(offset, eta, 2 * jnp.pi * uniforms[7])
