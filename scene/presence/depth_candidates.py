"""Candidate poses of slots in depth images: what they show in every frame, and their prior."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scene.execution import FAST_COMPILE, map_parallel
from scene.likelihood.object_density import object_density
from scene.likelihood.object_renderer import ObjectRenderer
from scene.likelihood.pixel_density import PixelDensity
from scene.model.contact import TOP_FACE
from scene.model.prior import PosePrior, contact_densities, log_floating
from scene.model.scene_graph import Bodies
from scene.observation.frame_data import SceneData
from scene.observation.segmentation import support_depth
from scene.presence.forests import ForestPrior, log_weighted_trees
from scene.presence.solids import log_sizes_density, solid_layers
from scene.presence.toggling import Candidates, SlotLayers
from scene.search.colour_layers import ColourLayers
from shapes.geometry.poses import matrices_of, poses_of
from shapes.geometry.rotation_densities import LOG_CONTACT_JACOBIAN

BATCH = 64
"""Layers of a kernel, as in the search."""

PAIRS = 4096
"""Of candidates, in one kernel."""

TOUCHING_SIGMAS = 10.0
"""Boxes further apart than so many standard deviations of a loose contact rest not on each other."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PresenceFrames:
    """The frames as presence sees them: all of their windows' pixels count.

    Attributes:
        views: F frames.
        densities: of their windows.
        camera_from_world: (F, 4, 4).
        supports_m: (H, W) each, depth of the supports.
        renderer: of the N objects' shapes, or of S draws of each, draw after draw.
        objects: N.
        draws: S.
        colours: of one of the frames and its number, where colours are compared.
        colour_weight: exponent of their factor.
    """

    views: Sequence[SceneData]
    densities: Sequence[PixelDensity]
    camera_from_world: NDArray[np.float64]
    supports_m: Sequence[NDArray[np.float32]]
    renderer: ObjectRenderer
    objects: int
    draws: int
    colours: tuple[int, ColourLayers] | None
    colour_weight: float

    @classmethod
    def of(
        cls,
        views: Sequence[SceneData],
        densities: Sequence[PixelDensity],
        camera_from_world: NDArray[np.float64],
        renderer: ObjectRenderer,
        objects: int,
        colours: tuple[int, ColourLayers] | None,
        colour_weight: float,
    ) -> PresenceFrames:
        """The frames with their supports rendered."""
        return cls(
            views=views,
            densities=densities,
            camera_from_world=camera_from_world,
            supports_m=[support_depth(one.supports, one.window, one.intrinsics) for one in views],
            renderer=renderer,
            objects=objects,
            draws=len(renderer.library) // objects,
            colours=colours,
            colour_weight=colour_weight,
        )

    @property
    def pixels(self) -> int:
        """Of all frames."""
        return sum(one.size for one in self.supports_m)

    def shown(
        self, rng: np.random.Generator, slots: NDArray[np.integer], poses: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Depth and log gain (n, X) of slots (n,) at poses (n, 7) world_from_box, each of a drawn shape."""
        numbers = rng.integers(self.draws, size=len(slots)) * self.objects + slots

        def in_frame(frame: int, in_camera: NDArray[np.float64]) -> tuple[NDArray[np.float32], ...]:
            layers_m = self.renderer.layers(numbers, in_camera, self.views[frame].window)
            depth_m, gain = self._weighed(frame, layers_m)
            if self.colours and self.colours[0] == frame:
                factors = self.colours[1].log_factors(slots, in_camera, layers_m)
                shown = np.isfinite(depth_m) & np.isfinite(layers_m)
                gain += np.where(shown, self.colour_weight * np.asarray(factors), 0)
            return depth_m, gain

        return self._in_all_frames(poses, in_frame)

    def shown_solids(
        self, states: NDArray[np.float64], is_round: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Depth and log gain (n, X) of solids (n, 10): world_from_solid and logs of half sizes."""

        def in_frame(frame: int, in_camera: NDArray[np.float64]) -> tuple[NDArray[np.float32], ...]:
            window, count = self.views[frame].window, len(in_camera)
            fill = np.resize(np.arange(count), BATCH * -(-count // BATCH)).reshape(-1, BATCH)
            given = np.float32(in_camera), np.float32(np.exp(states[:, 7:])), is_round

            def rendered(some: NDArray[np.intp]) -> NDArray[np.float32]:
                parts = (part[some] for part in given)
                return np.asarray(solid_layers(window.camera, *parts, *window.depth_m.shape))

            return self._weighed(frame, np.concatenate(map_parallel(rendered, fill))[:count])

        return self._in_all_frames(states[:, :7], in_frame)

    def _in_all_frames(
        self,
        poses: NDArray[np.float64],
        in_frame: Callable[[int, NDArray[np.float64]], tuple[NDArray[np.float32], ...]],
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        world_from_box, parts = matrices_of(poses), []
        for frame, camera_from_world in enumerate(self.camera_from_world):
            parts.append(in_frame(frame, poses_of(camera_from_world @ world_from_box)))
        depth_m, gain = (
            np.concatenate([part.reshape(len(poses), -1) for part in leaves], axis=1)
            for leaves in zip(*parts, strict=True)
        )
        return depth_m, gain

    def _weighed(
        self, frame: int, layers_m: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Depth and log gain (n, H, W) of layers (n, H, W) alone."""
        show = partial(self._batch, frame, layers_m)
        depth_m, gain = zip(*map_parallel(show, range(0, len(layers_m), BATCH)), strict=True)
        return np.concatenate(depth_m), np.concatenate(gain)

    def _batch(
        self, frame: int, layers_m: NDArray[np.float32], first: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        count = min(BATCH, len(layers_m) - first)
        filled = np.full((BATCH, *layers_m.shape[1:]), np.float32(np.inf))
        filled[:count] = layers_m[first : first + count]
        shown = _shown(self.densities[frame], filled, self.supports_m[frame], np.int32(count))
        return np.asarray(shown[0])[:count], np.asarray(shown[1])[:count]


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _shown(
    density: PixelDensity, layers_m: jax.Array, rest_m: jax.Array, count: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Depth and log gain (BATCH, H, W) of the first `count` layers (BATCH, H, W)."""
    log_rest = density.of_rest(rest_m)

    def show(one: jax.Array, shown: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        log_density, depth_m = object_density(density, layers_m[one], rest_m)
        depth_m = jnp.where(depth_m < rest_m, depth_m, jnp.inf)
        gain = jnp.where(jnp.isfinite(depth_m), log_density - log_rest, 0.0)
        return shown[0].at[one].set(depth_m), shown[1].at[one].set(gain)

    nothing = jnp.full(layers_m.shape, jnp.inf), jnp.zeros(layers_m.shape)
    return jax.lax.fori_loop(0, count, show, nothing)


def slot_layers(depth_m: NDArray[np.float32], log_gain: NDArray[np.float32]) -> SlotLayers:
    """Layers (K, X) of one slot where any of them shows anything."""
    pixels = np.flatnonzero(np.isfinite(depth_m).any(axis=0))
    return SlotLayers(
        pixels, np.ascontiguousarray(depth_m[:, pixels]), np.ascontiguousarray(log_gain[:, pixels])
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class PosePriors:
    """The chains' prior over poses of N objects, and of sets of them.

    Attributes:
        prior: of poses.
        half_m: (N, 3) half sizes of the objects' boxes.
        supports: (S, 7) poses of slabs.
        slab_half_m: (S, 3) their half sizes.
        floating_weight: of trees, the odds of floating.
        log_sets: (N + 1,) of sets, by their size.
        grafts: whether things rest on others; else all float.
    """

    prior: PosePrior
    half_m: NDArray[np.float64]
    supports: NDArray[np.float64]
    slab_half_m: NDArray[np.float64]
    floating_weight: float
    log_sets: NDArray[np.float64]
    grafts: bool

    def of(
        self, poses: NDArray[np.float64], half_m: NDArray[np.float64], log_rate: NDArray[np.float64]
    ) -> ForestPrior:
        """Of candidates (N + U, K, 7) world_from_box of objects that are asked for, and then of unknown solids.

        Args:
            poses: of the candidates.
            half_m: (N + U, K, 3) half sizes of their boxes.
            log_rate: (U, K) of the solids' sizes.
        """
        slots, count = poses.shape[:2]
        asked = slots - len(log_rate)
        rate = np.concatenate([np.ones((asked, count)), np.exp(log_rate)])
        on_others = np.zeros((slots * count, slots * count))
        log_trees = np.zeros(slots + 1)
        if self.grafts:
            child, parent = self._near(poses, half_m)
            flat = poses.reshape(-1, 7), half_m.reshape(-1, 3)
            on_others[child, parent] = self._contacts(*(part[np.stack([parent, child])] for part in flat))
            log_trees = log_weighted_trees(self.floating_weight, len(self.supports), slots)
        on_others = rate[..., None, None] * on_others.reshape(slots, count, slots, count)
        return ForestPrior(rate * self.alone(poses, half_m), on_others, log_trees, self.log_sets, asked)

    def alone(self, poses: NDArray[np.float64], half_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weights (n, S) of poses (n, S, 7) of boxes (n, S, 3) by themselves, floating or on a support."""
        with jax.enable_x64(True):
            floating = np.exp(np.asarray(log_floating(self.prior, jnp.asarray(poses[..., 4:]))))
        if not self.grafts:
            return floating
        shape = len(self.supports), floating.size
        two = [
            np.stack(
                [np.repeat(on[:, None], shape[1], axis=1), np.broadcast_to(own, (*shape, own.shape[-1]))]
            )
            for on, own in (
                (self.supports, poses.reshape(-1, 7)),
                (np.asarray(self.slab_half_m), half_m.reshape(-1, 3)),
            )
        ]
        contacts = self._contacts(*(part.reshape(2, -1, part.shape[-1]) for part in two), on_support=True)
        return self.floating_weight * floating + contacts.reshape(shape).sum(axis=0).reshape(floating.shape)

    def _near(
        self, poses: NDArray[np.float64], half_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Children and parents (P,) among the candidates of different slots whose boxes may touch."""
        owners = np.repeat(np.arange(len(poses)), poses.shape[1])
        places_m, radii = poses[..., 4:].reshape(-1, 3), np.linalg.norm(half_m, axis=-1).ravel()
        slack_m = TOUCHING_SIGMAS * float(self.prior.loose_sigma_m)
        near = KDTree(places_m).query_pairs(2 * radii.max() + slack_m, output_type="ndarray")
        far_m = np.linalg.norm(places_m[near[:, 0]] - places_m[near[:, 1]], axis=1)
        touch = far_m < radii[near].sum(axis=1) + slack_m
        first, second = near[touch & (owners[near[:, 0]] != owners[near[:, 1]])].T
        return np.append(first, second), np.append(second, first)

    def _contacts(
        self, poses: NDArray[np.float64], half_m: NDArray[np.float64], *, on_support: bool = False
    ) -> NDArray[np.float64]:
        """Densities (P,) of the second of two boxes at poses (2, P, 7) on the first, all pairs of faces."""
        count = poses.shape[1]
        densities = np.empty(count)
        faces = np.arange(6) == TOP_FACE if on_support else np.ones(6, bool)
        for first in range(0, count, PAIRS):
            part = np.resize(np.arange(first, min(first + PAIRS, count)), PAIRS)
            with jax.enable_x64(True):
                found = np.asarray(_on_another(self.prior, faces, half_m[:, part], poses[:, part]))
            densities[first : first + PAIRS] = found[: count - first]
        return np.exp(LOG_CONTACT_JACOBIAN) * densities


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
        two = Bodies(half_m, jnp.ones(2, bool), jnp.stack([faces, faces]))
        return jnp.sum(contact_densities(prior, two, poses, jnp.int32(1))[0])

    return jax.vmap(one, in_axes=1)(half_m, poses)


def candidates_of(
    rng: np.random.Generator,
    frames: PresenceFrames,
    priors: PosePriors,
    states: NDArray[np.float64],
    is_round: NDArray[np.bool_],
    log_offered: NDArray[np.float64],
    log_hidden: NDArray[np.float64],
) -> Candidates:
    """Candidates ready for moves.

    Args:
        rng: random numbers.
        frames: what is seen.
        priors: of poses.
        states: (N + U, K, 10) world_from_box and logs of half sizes, of N objects and then of U solids.
        is_round: (U,) which of these are cylinders.
        log_offered: (N + U, K) log q.
        log_hidden: (N,).
    """
    slots, count = log_offered.shape
    asked = slots - len(is_round)
    seen = [frames.shown(rng, np.repeat(np.arange(asked), count), states[:asked, :, :7].reshape(-1, 7))]
    if len(is_round):
        seen.append(frames.shown_solids(states[asked:].reshape(-1, 10), np.repeat(is_round, count)))
    depth_m, gain = (np.concatenate(leaves) for leaves in zip(*seen, strict=True))
    layers = [
        slot_layers(depth_m[first : first + count], gain[first : first + count])
        for first in range(0, slots * count, count)
    ]
    log_rate = log_sizes_density(states[asked:, :, 7:], is_round[:, None])
    prior = priors.of(states[..., :7], np.exp(states[..., 7:]), log_rate)
    log_hidden = np.append(log_hidden, np.full(len(is_round), -np.inf))
    return Candidates(layers, log_offered, prior, log_hidden, frames.pixels)
