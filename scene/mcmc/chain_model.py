"""The chains' target: which supports carry, where floating objects may be, the bodies and their prior."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from scene.config import ParseConfig
from scene.model.contact import TOP_FACE
from scene.model.posterior import Likelihood, SceneModel
from scene.model.prior import FLOATING_HEIGHT_M, PosePrior, WeightedTrees
from scene.model.scene_graph import Bodies
from scene.objects.scene_object import SceneObject
from scene.observation.detection import SupportPlane
from scene.search.search_result import Initialisation
from shapes.geometry.poses import matrices_of, poses_of

TABLE_HALF_THICKNESS_M = 0.01

FREE_HALF_SIZE_M = 1.5
"""Of the cuboid in front of the camera that holds objects where there is no table."""

SPACE_MARGIN_M = 0.05
"""Of that cuboid round the places where chains start."""

CARRIED_M = 0.05
"""An object whose lowest point is no further from a support may stand on it: some errors of supports."""


def carrying(
    supports: Sequence[SupportPlane], objects: Sequence[SceneObject], start: Initialisation
) -> list[SupportPlane]:
    """The first support, and those of the others that an object of the best scene may stand on."""
    placed_m = [
        objects[one].points_m @ matrices_of(start.poses[one])[:3, :3].T + start.poses[one, 4:]
        for one in np.flatnonzero(start.found).tolist()
    ]

    def carries(support: SupportPlane) -> bool:
        inside = [support.in_table_frame(points_m) for points_m in placed_m]
        feet = [points_m[np.argmin(points_m[:, 2])] for points_m in inside]
        return any(abs(foot[2]) < CARRIED_M and support.covers(foot) for foot in feet)

    return [one for number, one in enumerate(supports) if number == 0 or carries(one)]


def slabs_under(
    supports: Sequence[SupportPlane], world_from_camera: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Poses (S, 7) of the slabs under the supports in the world."""
    down = np.eye(4)
    down[2, 3] = -TABLE_HALF_THICKNESS_M
    matrices = [world_from_camera @ one.camera_from_table @ down for one in supports]
    return poses_of(np.stack(matrices)) if matrices else np.zeros((0, 7))


def prior_space(
    table: SupportPlane | None, starts_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners of the cuboid that holds floating objects: over the table, or before the camera without one.

    It is widened to hold the centres (N, 3) where chains start, so that none starts where it cannot be.
    """
    if table is None:
        low = np.array([-FREE_HALF_SIZE_M, -FREE_HALF_SIZE_M, 0.0])
        high = np.array([FREE_HALF_SIZE_M, FREE_HALF_SIZE_M, 2 * FREE_HALF_SIZE_M])
    else:
        low = np.append(-table.half_size_m, -TABLE_HALF_THICKNESS_M)
        high = np.append(table.half_size_m, FLOATING_HEIGHT_M)
    return (
        np.minimum(low, np.min(starts_m - SPACE_MARGIN_M, axis=0, initial=np.inf)),
        np.maximum(high, np.max(starts_m + SPACE_MARGIN_M, axis=0, initial=-np.inf)),
    )


def scene_model(
    supports: Sequence[SupportPlane],
    objects: Sequence[SceneObject],
    likelihood: Likelihood,
    space: tuple[NDArray[np.float64], NDArray[np.float64]],
    config: ParseConfig,
) -> SceneModel:
    """The target in the table's frame; supports are the last bodies, slabs under them."""
    prior = pose_prior(supports, space, config)
    trees = WeightedTrees(jnp.asarray(config.floating_weight)) if supports else WeightedTrees.uniform()
    return SceneModel(_bodies(objects, supports), prior, trees, likelihood)


def pose_prior(
    supports: Sequence[SupportPlane],
    space: tuple[NDArray[np.float64], NDArray[np.float64]],
    config: ParseConfig,
) -> PosePrior:
    """Its prior of poses, with the corners of the cuboid that holds what floats."""
    return PosePrior(
        low_m=jax.device_put(space[0]),
        high_m=jax.device_put(space[1]),
        contact_sigma_m=jnp.asarray(config.contact_sigma_m),
        loose_sigma_m=jnp.asarray(config.loose_sigma_m),
        contact_concentration=jnp.asarray(config.contact_concentration),
        slack_share=jnp.asarray(config.slack_share),
        upward_concentration=jnp.asarray(config.upward_concentration if supports else 0.0),
    )


def half_sizes(supports: Sequence[SupportPlane]) -> NDArray[np.float64]:
    """(S, 3) of the slabs under the supports."""
    sizes = [np.append(one.half_size_m, TABLE_HALF_THICKNESS_M) for one in supports]
    return np.stack(sizes) if sizes else np.zeros((0, 3))


def _bodies(objects: Sequence[SceneObject], supports: Sequence[SupportPlane]) -> Bodies:
    """The objects, then a slab under each support."""
    half_extents = [*(one.half_extents_m for one in objects), *half_sizes(supports)]
    movable = np.arange(len(half_extents)) < len(objects)
    supporting = movable[:, None] | (np.arange(6) == TOP_FACE)
    return Bodies(*map(jax.device_put, (np.stack(half_extents), movable, supporting)))
