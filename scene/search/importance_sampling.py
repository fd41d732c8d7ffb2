"""Gaussians round the modes of each object's pose given the rest of the scene, with their masses.

Adaptive importance sampling (population Monte Carlo, Cappe et al. 2004): Gaussians round the poses of the
best scene and round distant poses of similar density are sampled, weighted by the likelihood at a temperature
that keeps enough draws alive, and fitted again, all modes in parallel. The mean weight is the mode's mass.
Gives starts and proposals of the chains.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, softmax

from recordings.types import DepthNoise
from scene.likelihood.object_renderer import ObjectRenderer
from scene.likelihood.one_object import DepthEvidence, depth_evidence, log_likelihood_ratio
from scene.objects.symmetry import better_restarts, symmetric_restarts
from scene.observation.frame_data import SceneData
from scene.search.search_result import Initialisation
from shapes.geometry.camera import Camera
from shapes.geometry.poses import matrices_of, poses_of
from shapes.rendering.ray_casting import PosedObjects

MODES = 6
"""Of an object, that are kept."""

SOUGHT, WORSE = 8, 25.0
"""Modes of an object that are looked at, and nats by which their poses in the pool may be worse."""

HOPELESS = 30.0
"""Nats by which a mode's mass is less than the best one's after the first turn when it is given up."""

APART_M, APART_RAD = 0.02, 0.35
"""Poses that are closer belong to one mode; half of that is enough where they have found their place."""

DRAWS, TOGETHER, TURNS = 96, 4, 5
"""Draws from a Gaussian and turn, and Gaussians in one kernel."""

PIXEL_WEIGHT = 0.25
"""Exponent of the sensor's density, which takes neighbouring pixels for independent. Gaussians are starts and
proposals, so that it has no part in what chains and search compare."""

ALIVE = 30.0
"""Effective number of draws to which a turn is tempered."""

FIRST_SIGMA = np.repeat([0.004, 0.05], 3)

LEAST_SIGMA = np.repeat([0.0001, 0.002], 3)

WIDER = 1.15

BISECTIONS = 14


@dataclass(frozen=True, kw_only=True, eq=False)
class Refinement:
    """Gaussians on the poses of N objects, offset in the camera and turn of the box, the heaviest mode first.

    Attributes:
        means: (N, MODES, 7) camera_from_box.
        covariances: (N, MODES, 6, 6).
        log_masses: (N, MODES) of the posterior given the rest of the scene, 0 for the heaviest mode, -inf
            for places without use; good to some nats.
        visible_fraction: (N,) share of the object's pixels that nothing hides.
    """

    means: NDArray[np.float64]
    covariances: NDArray[np.float64]
    log_masses: NDArray[np.float64]
    visible_fraction: NDArray[np.float64]

    def seen_from(self, other_from_camera: NDArray[np.float64]) -> Refinement:
        """The same in another camera's frame (4, 4), in which offsets turn with it."""
        turn = np.eye(6)
        turn[:3, :3] = other_from_camera[:3, :3]
        return replace(
            self,
            means=poses_of(other_from_camera @ matrices_of(self.means)),
            covariances=turn @ self.covariances @ turn.T,
        )

    def with_rows(self, which: NDArray[np.bool_], other: Refinement) -> Refinement:
        """Objects `which` (N,) as another one tells of them."""
        return Refinement(
            **{
                name: np.where(which.reshape(-1, *[1] * (mine.ndim - 1)), getattr(other, name), mine)
                for name, mine in vars(self).items()
            }
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fits:
    """Gaussians under way, J of them.

    Attributes:
        owners: (J,) the object that each belongs to.
        means: (J, 7).
        factors: (J, 6, 6) lower factors of the covariances.
        log_masses: (J,) up to a constant of the owner's.
    """

    owners: NDArray[np.intp]
    means: NDArray[np.float64]
    factors: NDArray[np.float64]
    log_masses: NDArray[np.float64]

    def at(self, places: Any) -> _Fits:
        """Some of them."""
        return _Fits(
            owners=self.owners[places],
            means=self.means[places],
            factors=self.factors[places],
            log_masses=self.log_masses[places],
        )

    def behind(self) -> NDArray[np.float64]:
        """(J,) nats by which each is lighter than its owner's heaviest."""
        heaviest = np.full(self.owners.max() + 1, -np.inf)
        np.maximum.at(heaviest, self.owners, self.log_masses)
        return heaviest[self.owners] - self.log_masses


def refine(
    key: jax.Array,
    data: SceneData,
    renderer: ObjectRenderer,
    numbers: NDArray[np.integer],
    start: Initialisation,
    noise: DepthNoise,
    lines: NDArray[np.float64],
    moving: NDArray[np.bool_] | None = None,
) -> Refinement:
    """Gaussians round the poses of the best scene and their rivals, on one frame.

    Args:
        key: random key.
        data: the frame.
        renderer: of these objects and others.
        numbers: (N,) of the objects among the renderer's.
        start: the best scene, and the pools.
        noise: of the sensor and the surfaces together.
        lines: (N, 2, 3) about which objects are round, as `SceneObject.spin_line`.
        moving: (N,) which ones; all that were found if not told. The others stay where they are.
    """
    count = len(start.poses)
    moving = start.found if moving is None else moving
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    spins = _better_spins(data, renderer, numbers, start, noise, lines)
    fits = _first(start, spins)
    visible = np.zeros(count)
    for turn in range(TURNS):
        heaviest = np.array([_heaviest(fits, one) for one in range(count)])
        rest_m, visible = without_each(data, renderer, numbers, fits.means[heaviest], start.found)
        parts = []
        active = np.flatnonzero(moving[fits.owners])
        for places in _batches(len(active), TOGETHER):
            batch = fits.at(active[places])
            normal = rng.standard_normal((len(places), DRAWS, 6))
            normal[:, 0] = 0.0
            tangents = np.einsum("nij,nsj->nsi", batch.factors, normal)
            poses = np.asarray(_moved(batch.means, tangents), np.float64)
            log_ratio = _log_ratio(data, renderer, numbers, batch.owners, poses, rest_m, noise)
            log_weights = PIXEL_WEIGHT * log_ratio + 0.5 * (normal**2).sum(axis=-1)
            parts.append(_fitted(batch, tangents, log_weights))
        fits = _put(fits, active, parts)
        if turn == 0:
            fits = fits.at(fits.behind() < HOPELESS)
    return _kept(fits, visible)


def _better_spins(
    data: SceneData,
    renderer: ObjectRenderer,
    numbers: NDArray[np.integer],
    start: Initialisation,
    noise: DepthNoise,
    lines: NDArray[np.float64],
) -> list[NDArray[np.float64]]:
    """Poses (M, 7) of each object that look better than the best scene's, spun about its line."""
    spins = [np.zeros((0, 7)) for _ in lines]
    lined = np.flatnonzero(lines[:, 0].any(axis=1) & start.found)
    if not len(lined):
        return spins
    owners = np.resize(lined, TOGETHER * -(-len(lined) // TOGETHER))
    poses = symmetric_restarts(start.poses[owners], lines[owners], DRAWS)
    rest_m, _ = without_each(data, renderer, numbers, start.poses, start.found)
    log_ratio = _log_ratio(data, renderer, numbers, owners, poses, rest_m, noise)
    for row, one in enumerate(lined.tolist()):
        spins[one] = poses[row, better_restarts(log_ratio[row])]
    return spins


def _first(start: Initialisation, spins: list[NDArray[np.float64]]) -> _Fits:
    """Wide Gaussians round the best poses, in order, round spins that look better, and round others.

    Those are of the pools, and as good.
    """
    owners, means = list(range(len(start.poses))), list(start.poses)
    for one in np.flatnonzero(start.found).tolist():
        gains = start.log_gains[one, : start.pools.shape[1]]
        seen = np.concatenate([start.poses[one][None], spins[one]])
        for place in np.argsort(-gains):
            if gains[place] < -WORSE or len(seen) == SOUGHT:
                break
            if apart(start.pools[one, place], seen, 1.0).all():
                seen = np.append(seen, start.pools[one, place][None], axis=0)
        owners += [one] * (len(seen) - 1)
        means += list(seen[1:])
    return _Fits(
        owners=np.array(owners),
        means=np.stack(means),
        factors=np.tile(np.diag(FIRST_SIGMA), (len(means), 1, 1)),
        log_masses=np.where(np.arange(len(means)) < len(start.poses), 0.0, -np.inf),
    )


def apart(pose: NDArray[np.float64], others: NDArray[np.float64], share: float) -> NDArray[np.bool_]:
    """Whether a pose (7,) is further than a share of APART from others (K, 7)."""
    angle = 2 * np.arccos(np.minimum(np.abs(others[:, :4] @ pose[:4]), 1.0))
    offset = np.linalg.norm(others[:, 4:] - pose[4:], axis=1)
    return (angle > share * APART_RAD) | (offset > share * APART_M)


def distinct(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Those of poses (S, 7) that are apart from all before."""
    sites = poses[:1]
    for pose in poses[1:]:
        if apart(pose, sites, 0.5).all():
            sites = np.append(sites, pose[None], axis=0)
    return sites


def _heaviest(fits: _Fits, one: int) -> int:
    return int(np.argmax(np.where(fits.owners == one, fits.log_masses, -np.inf)))


def _batches(count: int, together: int) -> list[NDArray[np.intp]]:
    """Places in equal batches, the last one filled up with the last place."""
    return [np.minimum(first + np.arange(together), count - 1) for first in range(0, count, together)]


def _put(fits: _Fits, places: NDArray[np.intp], parts: list[_Fits]) -> _Fits:
    """The Gaussians with others, in parts of which the last is filled up, in some places."""
    if not parts:
        return fits

    def put(name: str) -> NDArray:
        leaf = getattr(fits, name).copy()
        leaf[places] = np.concatenate([getattr(part, name) for part in parts])[: len(places)]
        return leaf

    return replace(fits, means=put("means"), factors=put("factors"), log_masses=put("log_masses"))


def _fitted(fits: _Fits, tangents: NDArray[np.float64], log_weights: NDArray[np.float64]) -> _Fits:
    """The Gaussians of weighted draws (J, S, 6) from these ones, and the masses that the draws tell."""
    weights = np.stack([tempered(one, ALIVE) for one in log_weights])
    steps = np.einsum("ns,nsi->ni", weights, tangents)
    spread = tangents - steps[:, None]
    covariances = np.einsum("ns,nsi,nsj->nij", weights, spread, spread) + np.diag(LEAST_SIGMA**2)
    log_volumes = np.log(np.einsum("nii->ni", fits.factors)).sum(axis=1)
    return replace(
        fits,
        means=np.asarray(_moved(fits.means, steps[:, None]), np.float64)[:, 0],
        factors=WIDER * np.linalg.cholesky(covariances),
        log_masses=logsumexp(log_weights, axis=1) + log_volumes,
    )


def _kept(fits: _Fits, visible: NDArray[np.float64]) -> Refinement:
    """The modes of every object that have not met a heavier one."""
    count = len(visible)
    places, log_masses = np.zeros((count, MODES), np.intp), np.full((count, MODES), -np.inf)
    for one in range(count):
        mine = np.flatnonzero(fits.owners == one)
        kept: list[int] = []
        for place in mine[np.argsort(-fits.log_masses[mine])]:
            if len(kept) < MODES and apart(fits.means[place], fits.means[kept], 0.5).all():
                kept.append(int(place))
        places[one] = np.resize(kept, MODES)
        log_masses[one, : len(kept)] = fits.log_masses[kept] - fits.log_masses[kept[0]]
    factors = fits.factors[places]
    return Refinement(
        means=fits.means[places],
        covariances=factors @ np.swapaxes(factors, 2, 3),
        log_masses=log_masses,
        visible_fraction=visible,
    )


def tempered(log_weights: NDArray[np.float64], least: float) -> NDArray[np.float64]:
    """Normalised weights (S,) to the largest power up to 1 that leaves so many effective draws."""

    def alive(power: float) -> float:
        return float(1 / (softmax(power * log_weights) ** 2).sum())

    if alive(1.0) >= least:
        return softmax(log_weights)
    low, high = 0.0, 1.0
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if alive(middle) >= least else (low, middle)
    return softmax(low * log_weights)


def without_each(
    data: SceneData,
    renderer: ObjectRenderer,
    numbers: NDArray[np.integer],
    poses: NDArray[np.float64],
    found: NDArray[np.bool_],
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Depth (N, H, W) of the scene without each object, and the share (N,) of each that it does not hide."""
    count = len(poses)
    depth = renderer.layers(numbers, poses, data.window)
    depth = np.where(found[:, None, None], depth, np.float32(np.inf))
    others = [np.delete(depth, one, axis=0).min(axis=0, initial=np.inf) for one in range(count)]
    rest_m = np.minimum(np.stack(others), data.rest_m)
    covers = np.isfinite(depth)
    shown = covers & (depth <= rest_m)
    return rest_m.astype(np.float32), shown.sum(axis=(1, 2)) / np.maximum(covers.sum(axis=(1, 2)), 1)


def _log_ratio(
    data: SceneData,
    renderer: ObjectRenderer,
    numbers: NDArray[np.integer],
    owners: NDArray[np.intp],
    poses: NDArray[np.float64],
    rest_m: NDArray[np.float32],
    noise: DepthNoise,
) -> NDArray[np.float64]:
    """Log likelihood ratio (J, S) of the image with the owner (J,) at poses (J, S, 7) and without it."""
    count, draws = poses.shape[:2]
    places = np.repeat(owners.astype(np.int32), draws)
    objects = np.asarray(numbers, np.int32)[places]
    flat = poses.reshape(-1, 7).astype(np.float32)
    camera, observed_m = data.window.camera, data.window.depth_m
    evidence, posed = _posed_before_rests(renderer, noise, camera, observed_m, rest_m, places, objects, flat)
    ratio = log_likelihood_ratio(renderer.library, noise, evidence, posed)
    return ratio.astype(np.float64).reshape(count, draws)


@jax.jit
def _posed_before_rests(
    renderer: ObjectRenderer,
    noise: DepthNoise,
    camera: Camera,
    observed_m: jax.Array,
    rest_m: jax.Array,
    places: jax.Array,
    objects: jax.Array,
    poses: jax.Array,
) -> tuple[DepthEvidence, PosedObjects]:
    """The image against rests (N, H, W), and objects (M,) at poses (M, 7), each before its place's rest."""
    cameras = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, len(rest_m)), camera)
    evidence = depth_evidence(noise, cameras, observed_m[None], rest_m)
    return evidence, renderer.posed(objects, poses, places)


@jax.jit
def _moved(poses: jax.Array, steps: jax.Array) -> jax.Array:
    """Poses (N, S, 7) from poses (N, 7) by steps (N, S, 6)."""

    def move(pose: jax.Array, step: jax.Array) -> jax.Array:
        turned = jaxlie.SO3(pose[:4]) @ jaxlie.SO3.exp(step[3:])
        return jnp.concatenate([turned.normalize().wxyz, pose[4:] + step[:3]])

    return jax.vmap(jax.vmap(move, in_axes=(None, 0)))(poses, steps)
