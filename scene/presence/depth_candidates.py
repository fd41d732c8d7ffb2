"""Candidate poses of slots in depth images: what they show in every frame, and their prior."""

from __future__ import annotations

from collections.abc import Sequence
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
from scene.model.prior import PosePrior, contact_densities, log_floating
from scene.model.scene_graph import Bodies
from scene.observation.frame_data import SceneData
from scene.observation.segmentation import support_depth
from scene.presence.forests import ForestPrior, log_weighted_trees
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
        world_from_box = matrices_of(poses)
        depths, gains = [], []
        for frame, camera_from_world in enumerate(self.camera_from_world):
            in_camera = poses_of(camera_from_world @ world_from_box)
            depth_m, gain = self._in_frame(frame, numbers, in_camera)
            depths.append(depth_m.reshape(len(slots), -1))
            gains.append(gain.reshape(len(slots), -1))
        return np.concatenate(depths, axis=1), np.concatenate(gains, axis=1)

    def _in_frame(
        self, frame: int, numbers: NDArray[np.integer], poses: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        window = self.views[frame].window
        layers_m = self.renderer.layers(numbers, poses, window)
        colour = np.zeros((1, *layers_m.shape[1:]), np.float32)
        if self.colours and self.colours[0] == frame:
            factors = self.colours[1].log_factors(numbers % self.objects, poses, layers_m)
            colour = self.colour_weight * np.asarray(factors)
        show = partial(self._batch, frame, layers_m)
        depth_m, gain = zip(*map_parallel(show, range(0, len(layers_m), BATCH)), strict=True)
        depth_m = np.concatenate(depth_m)
        shown = np.isfinite(depth_m) & np.isfinite(layers_m)
        return depth_m, np.concatenate(gain) + np.where(shown, colour, 0)

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
        bodies: the objects, then supports.
        supports: (S, 7) poses of these.
        floating_weight: of trees, the odds of floating.
        log_sets: (N + 1,) of sets, by their size.
        grafts: whether things rest on others; else all float.
    """

    prior: PosePrior
    bodies: Bodies
    supports: NDArray[np.float64]
    floating_weight: float
    log_sets: NDArray[np.float64]
    grafts: bool

    def of(self, poses: NDArray[np.float64]) -> ForestPrior:
        """Of candidates (N, K, 7) world_from_box."""
        slots, count = poses.shape[:2]
        on_root = self.alone(np.arange(slots), poses)
        on_others = np.zeros((slots * count, slots * count))
        if self.grafts:
            child, parent = self._near(poses.reshape(-1, 7))
            owners = np.repeat(np.arange(slots), count)
            on_others[child, parent] = self._contacts(owners, poses.reshape(-1, 7), child, parent)
            log_trees = log_weighted_trees(self.floating_weight, len(self.supports), slots)
        else:
            log_trees = np.zeros(slots + 1)
        on_others = on_others.reshape(slots, count, slots, count)
        return ForestPrior(on_root, on_others, log_trees, self.log_sets)

    def alone(self, slots: NDArray[np.integer], poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weights (n, S) of objects (n,) at poses (n, S, 7) by themselves, floating or on a support."""
        with jax.enable_x64(True):
            floating = np.exp(np.asarray(log_floating(self.prior, jnp.asarray(poses[..., 4:]))))
        if not self.grafts:
            return floating
        every = np.concatenate([poses.reshape(-1, 7), self.supports])
        count, supports = floating.size, len(self.supports)
        bodies = np.append(np.repeat(slots, poses.shape[1]), self.objects + np.arange(supports))
        child, on = (part.ravel() for part in np.indices((count, supports)))
        contacts = self._contacts(bodies, every, child, count + on).reshape(*floating.shape, supports)
        return self.floating_weight * floating + contacts.sum(axis=-1)

    @property
    def objects(self) -> int:
        """N."""
        return len(self.bodies.half_extents_m) - len(self.supports)

    def _near(self, poses: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Children and parents (P,) among the candidates whose boxes may touch."""
        half = np.asarray(self.bodies.half_extents_m)[: self.objects]
        owners = np.repeat(np.arange(self.objects), len(poses) // self.objects)
        radii = np.linalg.norm(half, axis=1)[owners]
        slack_m = TOUCHING_SIGMAS * float(self.prior.loose_sigma_m)
        near = KDTree(poses[:, 4:]).query_pairs(2 * radii.max() + slack_m, output_type="ndarray")
        far_m = np.linalg.norm(poses[near[:, 0], 4:] - poses[near[:, 1], 4:], axis=1)
        touch = far_m < radii[near].sum(axis=1) + slack_m
        first, second = near[touch & (owners[near[:, 0]] != owners[near[:, 1]])].T
        return np.append(first, second), np.append(second, first)

    def _contacts(
        self,
        bodies: NDArray[np.integer],
        poses: NDArray[np.float64],
        child: NDArray[np.intp],
        parent: NDArray[np.intp],
    ) -> NDArray[np.float64]:
        """Densities (P,) of poses of children on parents, all pairs of faces together."""
        densities = np.empty(len(child))
        for first in range(0, len(child), PAIRS):
            part = slice(first, first + PAIRS)
            pairs = np.stack([np.resize(one[part], PAIRS) for one in (parent, child)], axis=1)
            with jax.enable_x64(True):
                found = np.asarray(_on_another(self.prior, self.bodies, bodies[pairs], poses[pairs]))
            densities[part] = found[: len(densities[part])]
        return np.exp(LOG_CONTACT_JACOBIAN) * densities


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _on_another(prior: PosePrior, bodies: Bodies, pairs: jax.Array, poses: jax.Array) -> jax.Array:
    """Densities (P,), of contacts, of the second of two bodies (P, 2) at poses (P, 2, 7) on the first."""

    def one(pair: jax.Array, poses: jax.Array) -> jax.Array:
        two = jax.tree.map(lambda leaf: leaf[pair], bodies)
        return jnp.sum(contact_densities(prior, two, poses, jnp.int32(1))[0])

    return jax.vmap(one)(pairs, poses)


def candidates_of(
    rng: np.random.Generator,
    frames: PresenceFrames,
    priors: PosePriors,
    poses: NDArray[np.float64],
    log_offered: NDArray[np.float64],
    log_hidden: NDArray[np.float64],
) -> Candidates:
    """Candidates at poses (N, K, 7) world_from_box, ready for moves."""
    slots, count = log_offered.shape
    numbers = np.repeat(np.arange(slots), count)
    depth_m, gain = frames.shown(rng, numbers, poses.reshape(-1, 7))
    layers = [
        slot_layers(depth_m[first : first + count], gain[first : first + count])
        for first in range(0, slots * count, count)
    ]
    return Candidates(layers, log_offered, priors.of(poses), log_hidden, frames.pixels)
