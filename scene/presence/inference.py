"""Presence in a parsed scene: candidates from the chains and from what the search rejected, then moves."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np
from numpy.typing import NDArray

from scene.config import ParseConfig
from scene.hidden.hidden_places import HiddenPlaces
from scene.likelihood.object_renderer import ObjectRenderer
from scene.likelihood.pixel_density import PixelDensity
from scene.mcmc.chain_model import half_sizes, slabs_under
from scene.mcmc.sampling import SampledScenes
from scene.mcmc.symmetry_arrays import SpinLines
from scene.model.number_prior import UncertainBinomialNumber
from scene.objects.scene_object import SceneObject
from scene.objects.slots import FoundObjects
from scene.observation.detection import SupportPlane
from scene.observation.frame_data import SceneData
from scene.presence.births import born_near, sites_of, solids_near
from scene.presence.depth_candidates import PresenceFrames
from scene.presence.pose_priors import PosePriors
from scene.presence.posterior import Presence, presence_posterior
from scene.presence.solids import SolidFits
from scene.search.colour_layers import ColourLayers
from scene.search.search_result import Initialisation
from shapes.geometry.poses import matrices_of, poses_of

ALONG = 0.9
"""Cosine to an axis of its box of the line about which a cylinder is round."""

MOST_SOLIDS, APART_M, UNFOUND = 12, 0.03, 20.0
"""Unknown solids that are looked at, how far apart they begin, and by how many nats places of what the search
left out come behind: what an object in one pose costs there."""

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
        half_m=np.stack([one.half_extents_m for one in objects]),
        supports=slabs_under(supports, world_from_camera),
        slab_half_m=half_sizes(supports),
        floating_weight=config.floating_weight if supports else 1.0,
        log_sets=UncertainBinomialNumber(config.presence).log_set_probabilities(len(objects)),
        grafts=config.graph == "infer",
    )
    last = chains.samples.poses[-1]
    starts = np.tile([1.0, 0, 0, 0, 0, 0, 0], (CHAINS, len(objects), 1))
    starts[:, found.indices] = last[np.arange(CHAINS) % len(last)][:, : len(found.indices)]
    sites = np.moveaxis(starts, 0, 1)
    for one in np.flatnonzero(~start.found).tolist():
        sites[one] = poses_of(world_from_camera @ matrices_of(sites_of(start, one, CHAINS)))
    lines = SpinLines.of(objects, 0)
    mixture = born_near(rng, frames, priors, sites, lines, start.found)
    solids = SolidFits.none()
    if config.unknown_solids:
        solids = _solids(rng, frames, priors, np.asarray(lines.directions), sites, start.found)
    return presence_posterior(rng, frames, priors, mixture, solids, CHAINS, hidden)


def _solids(
    rng: np.random.Generator,
    frames: PresenceFrames,
    priors: PosePriors,
    directions: NDArray[np.floating],
    sites: NDArray[np.float64],
    found: NDArray[np.bool_],
) -> SolidFits:
    """Unknown solids in the places (N, S, 7) world_from_box where objects explain something.

    A cylinder where the object is round about a direction (N, 3), else 0, that is near an axis of its box.
    """
    owners = np.repeat(np.arange(len(sites)), sites.shape[1])
    _, gain = frames.shown(rng, owners, sites.reshape(-1, 7))
    gains = gain.sum(axis=1, dtype=np.float64)
    places: list[int] = []
    for place in np.argsort(-np.where(found[owners], gains, gains - UNFOUND), kind="stable").tolist():
        middles_m = sites.reshape(-1, 7)[[place, *places], 4:]
        apart = np.linalg.norm(middles_m[1:] - middles_m[0], axis=1) > APART_M
        if (gains[place] > 0 or found[owners[place]]) and apart.all() and len(places) < MOST_SOLIDS:
            places.append(place)
    if not places:
        return SolidFits.none()
    along = np.abs(directions)[owners[places]]
    axes = np.where(along.max(axis=1) > ALONG, along.argmax(axis=1), -1)
    boxes = np.concatenate([sites.reshape(-1, 7)[places], np.log(priors.half_m[owners[places]])], axis=1)
    return solids_near(rng, frames, priors, boxes, axes)
