"""Objects of a parsed scene out of sight: where they may be, and with what probability.

Those that were not found may be there, and those that were found: what was taken for them may be another
thing. A priori they lie at rest on a support in sight of a camera, clear of what was found; without supports
anywhere in the region that was given. What was measured hides what is behind it, whatever it is; where
nothing was measured anything may hide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import jax
import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN, DepthNoise
from scene.config import EXACT_DRAWS, ParseConfig
from scene.hidden.depth_evidence import DepthImages, SeenImage, rendered_m
from scene.hidden.hidden_objects import hidden_posterior, mean_ratio
from scene.hidden.pose_priors import (
    EulerUniformPoses,
    NoRoomError,
    PlacedObject,
    PosePrior,
    RestingPoses,
    Support,
)
from scene.model.number_prior import NumberBesideOthers, UncertainBinomialNumber
from scene.objects.scene_object import SceneObject
from scene.observation.depth_view import PooledView
from scene.observation.frame_data import SceneData

DRAWS = 512
"""Prior poses of an object that is not asked for exactly: its share is then known to 0.02."""

WIDEST = 160
"""Columns of the images that are compared."""

CORRELATED_PX = 4.0
"""Edge of the squares of an image's pixels that count as one measurement: errors of neighbours are alike. One
in 14 to 20 pixels of real frames is independent of the others."""

KEPT = 256
"""Poses of the posterior that the result holds."""


@dataclass(frozen=True, kw_only=True, eq=False)
class HiddenPlaces:
    """What is known of N objects out of sight; a share of zero where there is no room for one.

    Attributes:
        share: (N,) mean likelihood ratio over prior poses: about the share of them that no image shows.
        share_std: (N,) its standard error.
        poses: (N, K, 4, 4) world_from_box, draws of the posterior given that the object is there.
        exact: presence and its standard error of objects asked for exactly, by number.
        both: probability that both are there, of two of these.
    """

    share: NDArray[np.float64]
    share_std: NDArray[np.float64]
    poses: NDArray[np.float64]
    exact: dict[int, tuple[float, float]]
    both: float = 0.0

    @classmethod
    def none(cls, count: int) -> HiddenPlaces:
        """Nothing is hidden."""
        poses = np.tile(np.eye(4), (count, KEPT, 1, 1))
        return cls(share=np.zeros(count), share_std=np.zeros(count), poses=poses, exact={})


def hidden_places(
    rng: np.random.Generator,
    views: Sequence[SceneData],
    camera_from_world: NDArray[np.float64],
    supports: Sequence[Support],
    objects: Sequence[SceneObject],
    placed: Mapping[int, PlacedObject],
    noise: DepthNoise,
    config: ParseConfig,
) -> HiddenPlaces:
    """Shares and poses of all objects out of sight; those that were found may be there instead.

    Args:
        rng: random numbers.
        views: one a frame.
        camera_from_world: (F, 4, 4); the region is told in the first camera.
        supports: on which objects can stand.
        objects: all N.
        placed: those found, in the world, by number.
        noise: of the sensor and the surfaces together.
        config: settings.

    Raises:
        ValueError: there is no room for an object asked for exactly, or nothing tells where it might be.
    """
    places = HiddenPlaces.none(len(objects))
    around = views, camera_from_world, tuple(supports), noise, config
    missing = [one for one in range(len(objects)) if one not in placed]
    asked = [one for one in missing if objects[one].name in config.exact]
    if not supports and not config.region:
        if asked:
            raise ValueError("no support was found; tell with --region where hidden objects may be")
        return places
    beside_all = _beside(placed, *around)
    for one in range(len(objects)):
        if one in asked:
            continue
        others = {number: known for number, known in placed.items() if number != one}
        prior, images = _beside(others, *around) if one in placed else beside_all
        with suppress(NoRoomError):
            ratio = mean_ratio(rng, [objects[one]], prior, images, draws=DRAWS, keep=KEPT)
            places.share[one], places.share_std[one] = ratio.mean, ratio.standard_error
            places.poses[one] = ratio.poses[0]
    if not asked:
        return places
    number = NumberBesideOthers(UncertainBinomialNumber(config.presence), len(placed))
    chosen = [objects[one] for one in asked]
    exact = hidden_posterior(rng, chosen, *beside_all, number, draws=EXACT_DRAWS, keep=KEPT)
    for rank, one in enumerate(asked):
        ratio = exact.ratios[(rank,)]
        places.share[one], places.share_std[one] = ratio.mean, ratio.standard_error
        places.poses[one] = exact.poses[rank]
        places.exact[one] = float(exact.presence[rank]), float(exact.standard_error[rank])
    return replace(places, both=exact.both)


def _beside(
    placed: Mapping[int, PlacedObject],
    views: Sequence[SceneData],
    camera_from_world: NDArray[np.float64],
    supports: tuple[Support, ...],
    noise: DepthNoise,
    config: ParseConfig,
) -> tuple[PosePrior, DepthImages]:
    """The prior of poses beside some objects, at rest in sight or in the region, and what images say."""
    known = list(placed.values())
    seen = [
        seen_image(view.view, pose, known, pixel_weight(view))
        for view, pose in zip(views, camera_from_world, strict=True)
    ]
    images = DepthImages(seen, noise)
    if supports:
        return RestingPoses(supports=supports, others=tuple(known), in_sight=images.seen), images
    low_m, high_m = np.array(config.region[:3]), np.array(config.region[3:])
    world_from_first = np.asarray(np.linalg.inv(camera_from_world[0]), np.float64)
    return EulerUniformPoses(low_m=low_m, high_m=high_m, world_from_cuboid=world_from_first), images


def pixel_weight(view: SceneData) -> float:
    """Effective over actual number of compared pixels."""
    apart = _stride(view.view) * view.intrinsics.fx / float(view.view.camera.fx)
    return min((apart / CORRELATED_PX) ** 2, 1.0)


def _stride(view: PooledView) -> int:
    return -(-view.depth_m.shape[1] // WIDEST)


def seen_image(
    view: PooledView, camera_from_world: NDArray[np.float64], placed: Sequence[PlacedObject], weight: float
) -> SeenImage:
    """A view in which what was measured, or a found object that is nearer, hides what is behind it.

    Every second pixel of a large one, or fewer: an object that is seen is seen in hundreds of them.
    """
    stride = _stride(view)
    depth_m = np.asarray(view.depth_m)[::stride, ::stride]
    camera = jax.tree.map(lambda leaf: leaf / stride, view.camera)
    rest_m = np.where(depth_m == NO_RETURN, 0, depth_m)[None].astype(np.float32)
    for one in placed:
        pose = one.world_from_box[None]
        rest_m = np.minimum(rest_m, rendered_m(camera, camera_from_world, one.shape, pose, depth_m.shape))
    return SeenImage(
        camera=camera,
        camera_from_world=camera_from_world,
        observed_m=depth_m,
        rest_m=rest_m,
        weight=weight,
    )
