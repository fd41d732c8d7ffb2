"""Presence in a parsed scene: candidates from the chains and from what the search rejected, then moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax
import numpy as np
from numpy.typing import NDArray

from scene.config import ParseConfig
from scene.hidden.hidden_places import HiddenPlaces
from scene.likelihood.object_renderer import ObjectRenderer
from scene.likelihood.pixel_density import PixelDensity
from scene.mcmc.chain_model import bodies_of, slabs_under
from scene.mcmc.pose_mixture import PoseMixture
from scene.mcmc.sampling import SampledScenes
from scene.mcmc.symmetry_arrays import SpinLines
from scene.model.number_prior import UncertainBinomialNumber
from scene.objects.scene_object import SceneObject
from scene.objects.slots import FoundObjects
from scene.observation.detection import SupportPlane
from scene.observation.frame_data import SceneData
from scene.presence.births import born_near, sites_of
from scene.presence.depth_candidates import PosePriors, PresenceFrames
from scene.presence.posterior import Presence, presence_posterior
from scene.search.colour_layers import ColourLayers
from scene.search.search_result import Initialisation
from shapes.geometry.poses import matrices_of, poses_of

CHAINS = 4
"""Whose differences tell the standard error."""


def presence_in_scene(
    rng: np.random.Generator,
    views: Sequence[SceneData],
    densities: Sequence[PixelDensity],
    camera_from_world: NDArray[np.float64],
    world_from_camera: NDArray[np.float64],
    supports: Sequence[SupportPlane],
    objects: Sequence[SceneObject],
    start: Initialisation,
    found: FoundObjects,
    chains: SampledScenes,
    hidden: HiddenPlaces,
    colours: tuple[int, ColourLayers] | None,
    config: ParseConfig,
) -> Presence:
    """Presence of all N objects.

    Args:
        rng: random numbers.
        views: one a frame.
        densities: of their windows.
        camera_from_world: (F, 4, 4).
        world_from_camera: (4, 4) of the frame that was searched.
        supports: that carry something, in that frame's camera.
        objects: all N.
        start: the best scene of the search, and its pools.
        found: which of the objects chains looked at.
        chains: what they left.
        hidden: what is known of objects that were not found.
        colours: of the searched frame and its number, where colours are compared.
        config: settings.
    """
    draws = ObjectRenderer.of_draws(objects) if config.shape_samples else ObjectRenderer.of(objects)
    weight = config.colour_weight
    frames = PresenceFrames.of(views, densities, camera_from_world, draws, len(objects), colours, weight)
    priors = PosePriors(
        prior=jax.device_get(chains.model.prior),
        bodies=jax.device_get(bodies_of(objects, supports)),
        supports=slabs_under(supports, world_from_camera),
        floating_weight=config.floating_weight if supports else 1.0,
        log_sets=UncertainBinomialNumber(config.presence).log_set_probabilities(len(objects)),
        grafts=config.graph == "infer",
    )
    mixture = _mixture(rng, frames, priors, world_from_camera, objects, start, found, chains.mixture)
    starts = np.tile([1.0, 0, 0, 0, 0, 0, 0], (CHAINS, len(objects), 1))
    last = chains.samples.poses[-1]
    starts[:, found.indices] = last[np.arange(CHAINS) % len(last)][:, : len(found.indices)]
    return presence_posterior(rng, frames, priors, mixture, starts, start.found, hidden)


def _mixture(
    rng: np.random.Generator,
    frames: PresenceFrames,
    priors: PosePriors,
    world_from_camera: NDArray[np.float64],
    objects: Sequence[SceneObject],
    start: Initialisation,
    found: FoundObjects,
    learned: PoseMixture,
) -> PoseMixture:
    """Where candidates of all N objects are drawn from."""
    parts, owners = [], []
    if len(found.indices):
        slots = np.arange(len(found.indices))
        parts.append(jax.tree.map(lambda leaf: np.asarray(leaf)[slots], learned))
        owners.append(found.indices)
    if missing := np.flatnonzero(~start.found).tolist():
        sites = world_from_camera @ matrices_of(np.stack([sites_of(start, one) for one in missing]))
        lines = SpinLines.of([objects[one] for one in missing], 0)
        births = born_near(rng, frames, priors, np.array(missing), poses_of(sites), lines)
        parts.append(jax.tree.map(np.asarray, births))
        owners.append(missing)
    components = max(part.log_weights.shape[1] for part in parts)
    parts = [_with_places(part, components) for part in parts]
    order = np.argsort(np.concatenate(owners))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[order], *parts)


def _with_places(mixture: PoseMixture, components: int) -> PoseMixture:
    """The mixture with unused places up to so many."""
    places = np.arange(components)
    taken = np.minimum(places, mixture.log_weights.shape[1] - 1)
    used = places < mixture.log_weights.shape[1]
    return replace(
        mixture,
        log_weights=np.where(used, mixture.log_weights[:, taken], -np.inf),
        centres=mixture.centres[:, taken],
        choleskys=mixture.choleskys[:, taken],
        whitenings=mixture.whitenings[:, taken],
    )
