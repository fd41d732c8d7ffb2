"""The chains' prior over poses, as weights of candidates by themselves and on each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from scene.config import ParseConfig
from scene.execution import FAST_COMPILE
from scene.likelihood.compared_frames import ComparedFrames
from scene.mcmc.chain_model import half_sizes, pose_prior, prior_space, slabs_under
from scene.model.contact import TOP_FACE
from scene.model.number_prior import UncertainBinomialNumber
from scene.model.prior import PosePrior, densities_on, log_floating
from scene.model.scene_graph import Bodies
from scene.objects.interior import Interior, penetrations_m
from scene.objects.scene_object import SceneObject
from scene.observation.detection import SupportPlane
from scene.presence.forests import ForestPrior, log_weighted_trees
from scene.presence.size_prior import SizePrior
from scene.search.support_prior import log_not_buried
from shapes.geometry.rotation_densities import LOG_CONTACT_JACOBIAN

PAIRS = 256
"""Of boxes, or boxes that float, in one call of a kernel: a candidate has some hundred others near it."""

TOUCHING_SIGMAS = 10.0
"""Boxes further apart than so many standard deviations of a loose contact rest not on each other."""

LEAST_DENSITY = 1e-30
"""Of the prior where it excludes a pose: what is fitted may still come to where it does not."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PosePriors:
    """The chains' prior over poses of N objects, the sizes', and that of sets of them.

    Attributes:
        prior: of poses.
        sizes: of the N objects.
        supports: (S, 7) poses of slabs.
        slab_half_m: (S, 3) their half sizes.
        floating_weight: of trees, the odds of floating.
        log_sets: (N + 1,) of sets, by their size.
        grafts: whether things rest on others; else all float.
        table: below which objects reach by no more than it may be wrong, in the world; None without one.
            Solids may go on there, as parts of things.
        contact_sigma_m: by which it, shapes and poses may be wrong.
        objects: all N.
    """

    prior: PosePrior
    sizes: SizePrior
    supports: NDArray[np.float64]
    slab_half_m: NDArray[np.float64]
    floating_weight: float
    log_sets: NDArray[np.float64]
    grafts: bool
    table: SupportPlane | None = None
    contact_sigma_m: float = 1.0
    objects: Sequence[SceneObject] = ()

    @classmethod
    def over(
        cls,
        compared: ComparedFrames,
        supports: Sequence[SupportPlane],
        objects: Sequence[SceneObject],
        most: int,
        centres_m: NDArray[np.float64],
        config: ParseConfig,
    ) -> PosePriors:
        """The priors of scenes of so many of the objects at most.

        Args:
            compared: the frames.
            supports: on which objects may stand, in the searched frame.
            objects: all N.
            most: of them.
            centres_m: (P, 3) in the world, of objects that float where the prior has to hold them.
            config: settings.
        """
        space = prior_space(compared.data.table, centres_m)
        return cls(
            prior=jax.device_get(pose_prior(supports, space, config)),
            sizes=SizePrior.of(objects, config.model_error_m),
            supports=slabs_under(supports, compared.world_from_camera),
            slab_half_m=half_sizes(supports),
            floating_weight=config.floating_weight if supports else 1.0,
            log_sets=UncertainBinomialNumber(config.presence).log_set_probabilities(most),
            grafts=config.graph == "infer",
            table=compared.table,
            contact_sigma_m=config.contact_sigma_m,
            objects=objects,
        )

    def of(
        self,
        poses: NDArray[np.float64],
        half_m: NDArray[np.float64],
        log_sizes: NDArray[np.float64],
        asked: int,
    ) -> ForestPrior:
        """Of candidates (N + U, K, 7) world_from_box of N objects that are asked for, then of solids.

        Args:
            poses: of the candidates.
            half_m: (N + U, K, 3) half sizes of their boxes.
            log_sizes: (N + U, K) log density of these, of solids with their rate.
            asked: N.
        """
        log_rate, slots = log_sizes.copy(), len(poses)
        log_rate[:asked] += self.log_not_buried(np.arange(asked), poses[:asked])
        rate = np.exp(log_rate)
        log_trees = np.zeros(slots + 1)
        if self.grafts:
            log_trees = log_weighted_trees(self.floating_weight, len(self.supports), slots)
        return ForestPrior(
            rate * self.alone(poses, half_m),
            cache(partial(self._weights_beside, poses, half_m, rate)),
            log_trees,
            self.log_sets,
            asked,
            cache(partial(self._log_apart_from, poses[:asked])) if self.objects else None,
        )

    def log_not_buried(self, owners: NDArray[np.integer], poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log prior (n, S) of how deep objects owners (n,) at poses (n, S, 7) reach below the table."""
        objects = [self.objects[one] for one in owners] if self.table else []
        return log_not_buried(self.table, objects, poses, self.contact_sigma_m)

    def log_apart(
        self, one: int, poses: NDArray[np.float64], other: int, other_pose: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Log prior (S,) of how deep two objects reach into each other, half a Gaussian.

        Of things that do not it is 0. The number of objects has its law before it counts, as that of a
        hard-core process (Strauss 1975).

        Args:
            one: number of an object.
            poses: (S, 7) of it.
            other: number of another.
            other_pose: (7,) of that.
        """
        depth_m = penetrations_m(self._interiors[one], poses, self._interiors[other], other_pose)
        return -0.5 * (depth_m / self.contact_sigma_m) ** 2

    def _log_apart_from(self, poses: NDArray[np.float64], slot: int, place: int) -> NDArray[np.float64]:
        """Log factors (N, K) of the candidates (N, K, 7) beside one of them, 0 within its slot."""
        found = np.zeros(poses.shape[:2])
        for other in range(len(poses)):
            if other != slot:
                found[other] = self.log_apart(other, poses[other], slot, poses[slot, place])
        return found

    @cached_property
    def _interiors(self) -> list[Interior]:
        """Of the N objects."""
        return [Interior.of(one) for one in self.objects]

    def log_alone(self, poses: NDArray[np.float64], half_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log of `alone` (n, S), finite everywhere."""
        return np.log(np.maximum(self.alone(poses, half_m), LEAST_DENSITY))

    def alone(self, poses: NDArray[np.float64], half_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weights (n, S) of poses (n, S, 7) of boxes (n, S, 3) by themselves, floating or on a support."""
        floating = self._floating(poses[..., 4:].reshape(-1, 3)).reshape(poses.shape[:2])
        if not self.grafts:
            return floating
        parts = (self.supports, poses), (self.slab_half_m, half_m)
        pairs = [np.stack(np.broadcast_arrays(on[:, None, None], own)) for on, own in parts]
        contacts = self._contacts(*(part.reshape(2, -1, part.shape[-1]) for part in pairs), on_support=True)
        return self.floating_weight * floating + contacts.reshape(len(self.supports), *floating.shape).sum(
            axis=0
        )

    def _weights_beside(
        self,
        poses: NDArray[np.float64],
        half_m: NDArray[np.float64],
        rate: NDArray[np.float64],
        slot: int,
        place: int,
    ) -> NDArray[np.float64]:
        """Weights (2, N, K) of each of the candidates (N, K, ...) on one of them, and of that on each."""
        weights = np.zeros((2, *rate.shape))
        if not self.grafts:
            return weights
        near = self._may_touch(poses, half_m, slot, place)
        pairs = []
        for part in (poses, half_m):
            one = np.broadcast_to(part[slot, place], part[near].shape)
            pairs.append(np.concatenate([[one, part[near]], [part[near], one]], axis=1))
        weights[:, near] = self._contacts(*pairs).reshape(2, -1)
        weights[0] *= rate
        weights[1] *= rate[slot, place]
        return weights

    def _may_touch(
        self, poses: NDArray[np.float64], half_m: NDArray[np.float64], slot: int, place: int
    ) -> NDArray[np.bool_]:
        """Which boxes (N, K) of other slots may touch one."""
        radii = np.linalg.norm(half_m, axis=-1)
        far_m = np.linalg.norm(poses[..., 4:] - poses[slot, place, 4:], axis=-1)
        slack_m = TOUCHING_SIGMAS * float(self.prior.loose_sigma_m)
        near = far_m < radii + radii[slot, place] + slack_m
        near[slot] = False
        return near

    def _floating(self, positions_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Densities (P,) of floating poses at positions (P, 3)."""
        with jax.enable_x64(True):
            return np.exp(
                _in_batches(lambda part: _log_floating(self.prior, positions_m[part]), len(positions_m))
            )

    def _contacts(
        self, poses: NDArray[np.float64], half_m: NDArray[np.float64], *, on_support: bool = False
    ) -> NDArray[np.float64]:
        """Densities (P,) of the second of two boxes at poses (2, P, 7) on the first, all pairs of faces."""
        faces = np.arange(6) == TOP_FACE if on_support else np.ones(6, bool)

        def densities(part: NDArray[np.intp]) -> jax.Array:
            prior, *boxes = jax.tree.map(np.float32, (self.prior, half_m[:, part], poses[:, part]))
            return _on_another(prior, faces, *boxes)

        return np.exp(LOG_CONTACT_JACOBIAN) * _in_batches(densities, poses.shape[1])


def _in_batches(values: Callable[[NDArray[np.intp]], jax.Array], count: int) -> NDArray[np.float64]:
    """What a kernel gives (count,) of items, named by their numbers (PAIRS,) in each call."""
    found = np.empty(count)
    for first in range(0, count, PAIRS):
        part = np.resize(np.arange(first, min(first + PAIRS, count)), PAIRS)
        found[first : first + PAIRS] = np.asarray(values(part))[: count - first]
    return found


_log_floating = jax.jit(log_floating, compiler_options=FAST_COMPILE)


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _on_another(prior: PosePrior, faces: jax.Array, half_m: jax.Array, poses: jax.Array) -> jax.Array:
    """Densities (P,), of contacts, of the second of two boxes (2, P, 3) at poses (2, P, 7) on the first.

    Args:
        prior: of poses.
        faces: (6,) bool, of the first, that carry.
        half_m: half sizes.
        poses: world_from_box.
    """

    def one(half_m: jax.Array, poses: jax.Array) -> jax.Array:
        carrier = Bodies(half_m[:1], jnp.ones(1, bool), faces[None])
        return jnp.sum(densities_on(prior, carrier, poses[:1], half_m[1], poses[1]))

    return jax.vmap(one, in_axes=1)(half_m, poses)
