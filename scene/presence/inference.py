"""Presence in a scene: candidates from refined poses and from what the search rejected, then moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from scene.config import ParseConfig
from scene.copies import copies_among
from scene.hidden.hidden_places import HiddenPlaces
from scene.likelihood.compared_frames import ComparedFrames
from scene.likelihood.object_renderer import ObjectRenderer
from scene.mcmc.chain_model import carrying
from scene.objects.scene_object import SceneObject
from scene.observation.frame_data import SceneData
from scene.presence.births import born_near, sites_of
from scene.presence.depth_candidates import PresenceFrames
from scene.presence.pose_priors import PosePriors
from scene.presence.posterior import Births, Presence, presence_posterior
from scene.presence.solid_births import competing_solids
from scene.presence.solids import SolidFits
from scene.search.importance_sampling import distinct
from scene.search.search_result import Initialisation
from shapes.geometry.poses import matrices_of, poses_of

PROPOSED_SITES = 24
"""Places that are tried of an object that the search did not find: its poses lie nats below their tops."""

PROPOSED_ELSEWHERE = 8
"""The same of an object that it found. Of 24 tables with decoys on two it had laid what was requested into a
larger box's face, with the true place in its pool (`bench poses --decoys`, seeds 130042 and 140042)."""

PLACES = 16
"""Particles of an object round which candidates are sought, evenly in the order of their densities: most are
near each other, and count once."""

CHAINS, FITS = 4, 2
"""Whose differences tell the standard error, and Gaussians for these, fitted anew each time: what chains tell
depends on the fits, too. A wood block that a free box explains nearly as well (YCB-Video's 0002/11) had
presence 1.00 by one fit and 0.04 by another, each with a standard error of 0.02."""


def presence_in_scene(
    rng: np.random.Generator,
    compared: ComparedFrames,
    novel: Mapping[int, SceneData],
    objects: Sequence[SceneObject],
    start: Initialisation,
    particles: NDArray[np.float64],
    hidden: HiddenPlaces,
    config: ParseConfig,
) -> Presence:
    """Presence of all N objects.

    Args:
        rng: random numbers.
        compared: the frames.
        novel: of them, by number, with the foreground in which unknown solids are looked for.
        objects: all N.
        start: the best scene of the search, and its pools.
        particles: (N, P, 7) world_from_box of the poses of what it found, the densest first.
        hidden: what is known of objects out of sight.
        config: settings.
    """
    draws = ObjectRenderer.of_draws(objects) if config.shape_samples else ObjectRenderer.of(objects)
    supports = carrying(compared.data.supports, objects, start)
    centres_m = particles[start.found, :, 4:].reshape(-1, 3)
    priors = PosePriors.over(compared, supports, objects, len(objects), centres_m, config)
    frames = PresenceFrames(compared=compared, renderer=draws, log_half=priors.sizes.log_half)
    places = [np.zeros((0, 7))] * len(objects)
    for one in np.flatnonzero(start.found).tolist():
        places[one] = distinct(particles[one, :: particles.shape[1] // PLACES])
    sites = _sites(compared.world_from_camera, objects, start, places)
    lines = np.stack([one.spin_line for one in objects])
    counts = np.array([len(at) for at in places])
    births = []
    for mixture in born_near(rng, frames, priors, sites, lines, counts, FITS):
        solids = SolidFits.none()
        if config.unknown_solids:
            solids = competing_solids(rng, frames, priors, novel, mixture)
        births.append(Births(mixture=mixture, solids=solids))
    alike = copies_among({one.name: one.points_m for one in objects})
    return presence_posterior(rng, frames, priors, births, CHAINS, hidden, alike, start.found)


def _sites(
    world_from_camera: NDArray[np.float64],
    objects: Sequence[SceneObject],
    start: Initialisation,
    places: Sequence[NDArray[np.float64]],
) -> list[NDArray[np.float64]]:
    """Where each object may be, poses (S, 7) world_from_box: its places (P, 7), then others of the search."""
    camera_from_world, sites = np.linalg.inv(world_from_camera), []
    for one, (known, at) in enumerate(zip(objects, places, strict=True)):
        most = PROPOSED_ELSEWHERE if len(at) else PROPOSED_SITES
        others = sites_of(start, one, most, known, poses_of(camera_from_world @ matrices_of(at)))
        sites.append(np.concatenate([at, poses_of(world_from_camera @ matrices_of(others))]))
    return sites
