"""Tables drawn from the model of `parse` itself: which objects are there, their poses, and the image.

Scenes are drawn from the priors of sections L and O of docs/model.md, images from the density of section L2,
pixel after pixel, unknown things included. What is not drawn: the camera and the table, which are given;
boxes and cylinders of free size, half of which would be longer than the table; scenes in which objects
enter each other or the table, which the prior allows and the search does not look for; and those with an
object whose middle no image shows, for what is there is in sight (`scene.hidden`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.synthesis.image_draws import drawn_image
from pipeline.synthesis.scene_draws import drawn_scene
from recordings.sensor_profile import UnknownTable
from recordings.types import CameraIntrinsics, DepthNoise, Frame
from scene.common_errors import with_common_errors
from scene.config import ParseConfig
from scene.hidden.pose_priors import meet
from scene.likelihood.object_renderer import ObjectRenderer
from scene.likelihood.pixel_density import EDGE_PX
from scene.likelihood.unknown_surfaces import UnknownWeights
from scene.mcmc.chain_model import half_sizes, pose_prior, prior_space, slabs_under
from scene.model.contact import TOP_FACE
from scene.model.number_prior import SHAPES
from scene.model.scene_graph import ROOT, Bodies
from scene.objects.scene_object import SceneObject
from scene.observation.depth_view import pixels_at
from scene.observation.detection import SupportPlane
from scene.observation.pixel_window import PITCH_RAD, window_of
from scene.observation.segmentation import support_depth
from scene.presence.size_prior import SizePrior
from shapes.geometry.poses import matrices_of, poses_of

WIDTH, HEIGHT = 64, 48
"""Of images, of which every pixel is compared."""
NOISE = DepthNoise(sigma_base_m=0.003)
TABLE_HALF_M = np.array([0.15, 0.11])
"""As much as these images hold at `DISTANCE_M`."""
DISTANCE_M, ELEVATIONS_DEG = 0.75, (35.0, 60.0)
SUNK_SIGMAS = 2.0
"""Standard deviations of the gap in a contact by which surfaces may lie under the table."""
FLUSH_SIGMAS = 3.0
"""Standard deviations of the direction of a contact about flush that count as flush."""
LEARNED_FROM = 8
"""Scenes of the prior, with independent errors, from which the unknown's weights are learned."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelTable:
    """A table that was drawn.

    Attributes:
        frame: the image.
        camera_from_table: (4, 4).
        there: (N,) which objects are there.
        camera_from_box: (N, 4, 4) where those are.
        at_rest: (N,) which of them lie in one of their stable ways, as the search looks for them; the prior
            also lets them lean at any angle, with its slack, and float.
        sizes_drawn: whether sizes were drawn from the prior that presence has of them; else they are the
            models', and the objects are off from where they appear by the errors that chains allow for.
    """

    frame: Frame
    camera_from_table: NDArray[np.float64]
    there: NDArray[np.bool_]
    camera_from_box: NDArray[np.float64]
    at_rest: NDArray[np.bool_]
    sizes_drawn: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class _Scene:
    """A scene of the prior, without the errors that its objects have in common.

    Attributes:
        camera_from_table: (4, 4).
        there: (N,) which objects are there.
        camera_from_box: (N, 4, 4) where those are.
        at_rest: (N,) as `ModelTable` has it.
        layers_m: (N, H, W) depth of each object alone, +inf beside it.
    """

    camera_from_table: NDArray[np.float64]
    there: NDArray[np.bool_]
    camera_from_box: NDArray[np.float64]
    at_rest: NDArray[np.bool_]
    layers_m: NDArray[np.float32]

    @property
    def rest_m(self) -> NDArray[np.float32]:
        """Depth (H, W) of the table."""
        return support_depth(
            [_support(self.camera_from_table)], window_of(_blank(), intrinsics()), intrinsics()
        )


def intrinsics() -> CameraIntrinsics:
    """A camera all of whose pixels are compared."""
    return CameraIntrinsics(
        width=WIDTH,
        height=HEIGHT,
        fx=1 / PITCH_RAD,
        fy=1 / PITCH_RAD,
        cx=(WIDTH - 1) / 2,
        cy=(HEIGHT - 1) / 2,
    )


def told_support(camera_from_table: NDArray[np.float64]) -> tuple[float, ...]:
    """The table's plane, as `ParseConfig.support` takes it."""
    return tuple(camera_from_table[:3, [3, 2]].T.ravel().tolist())


def draw_table(
    rng: np.random.Generator,
    objects: Sequence[SceneObject],
    config: ParseConfig,
    learned: UnknownWeights,
    *,
    sizes_drawn: bool,
) -> ModelTable:
    """A table of some of these objects.

    Args:
        rng: random numbers.
        objects: that are asked for.
        config: of the parse, whose priors are drawn from.
        learned: how well pixels foretell each other.
        sizes_drawn: as `ModelTable` has it.
    """
    scene = _drawn_scene(rng, objects, config, sizes_drawn=sizes_drawn)
    key = jax.random.key(int(rng.integers(2**31)))
    depth_m = drawn_image(
        key, scene.layers_m, scene.rest_m, NOISE, config.model_error_m, min(1.0, EDGE_PX), learned
    )
    radii_m = np.array([np.linalg.norm(one.half_extents_m) for one in objects], np.float64)
    error_m = 0.0 if sizes_drawn else config.model_error_m
    true = with_common_errors(rng, scene.camera_from_box[None], radii_m, config.scale_error, error_m)[0]
    return ModelTable(
        frame=Frame(time_ns=0, depth_m=depth_m),
        camera_from_table=scene.camera_from_table,
        there=scene.there,
        camera_from_box=true,
        at_rest=scene.at_rest,
        sizes_drawn=sizes_drawn,
    )


def learned_weights(
    rng: np.random.Generator, objects: Sequence[SceneObject], config: ParseConfig
) -> UnknownWeights:
    """Weights that foretell scenes of the prior seen with independent errors."""
    images = []
    for _ in range(LEARNED_FROM):
        scene = _drawn_scene(rng, objects, config, sizes_drawn=False)
        depth_m = np.minimum(scene.layers_m.min(axis=0), scene.rest_m)
        noisy_m = depth_m + NOISE.sigma_base_m * rng.standard_normal(depth_m.shape)
        images.append(np.where(np.isfinite(depth_m), noisy_m, 0.0).astype(np.float32))
    return UnknownWeights.learned(images, NOISE)


def unknown_table(learned: UnknownWeights) -> UnknownTable:
    """The same, as a sensor's profile has it."""
    weights = np.asarray(learned.weights, np.float64)
    return UnknownTable(
        pitches_rad=np.array([PITCH_RAD]),
        weights=(weights / weights.sum(axis=-1, keepdims=True))[None],
        scales=np.asarray(learned.scales, np.float64)[None],
        reach_m=float(learned.reach_m),
    )


def _drawn_scene(
    rng: np.random.Generator, objects: Sequence[SceneObject], config: ParseConfig, *, sizes_drawn: bool
) -> _Scene:
    camera_from_table = _camera_from_table(rng)
    share = rng.beta(SHAPES * config.presence, SHAPES * (1 - config.presence))
    there = rng.random(len(objects)) < share
    sizes = SizePrior.of(objects, config.model_error_m)
    states = np.concatenate([np.zeros((len(objects), 1, 7)), sizes.log_half[:, None]], axis=2)
    if sizes_drawn:
        states[:, 0, 7:] += sizes.sigma * rng.standard_normal(sizes.sigma.shape)
    half_m = np.exp(sizes.tied(states, np.arange(len(objects)))[:, 0, 7:])
    boxes, at_rest = np.tile(np.eye(4), (len(objects), 1, 1)), np.zeros(len(objects), bool)
    layers_m = np.full((len(objects), HEIGHT, WIDTH), np.inf, np.float32)
    present = np.flatnonzero(there)
    if len(present):
        chosen = [objects[one] for one in present.tolist()]
        placed, floats = _drawn_poses(rng, half_m[present], camera_from_table, config)
        sunk_m = SUNK_SIGMAS * config.contact_sigma_m
        while not (_is_possible(chosen, placed, sunk_m) and _is_in_sight(camera_from_table @ placed)):
            placed, floats = _drawn_poses(rng, half_m[present], camera_from_table, config)
        lies = np.array([_lies(*pair, config) for pair in zip(chosen, placed, strict=True)])
        at_rest[present] = lies & ~floats
        boxes[present] = camera_from_table @ placed
        scales = half_m / np.exp(sizes.log_half)
        renderer, window = ObjectRenderer.of(objects), window_of(_blank(), intrinsics())
        layers_m[present] = renderer.layers(present, poses_of(boxes[present]), window, scales[present])
    return _Scene(
        camera_from_table=camera_from_table,
        there=there,
        camera_from_box=boxes,
        at_rest=at_rest,
        layers_m=layers_m,
    )


def _drawn_poses(
    rng: np.random.Generator,
    half_m: NDArray[np.float64],
    camera_from_table: NDArray[np.float64],
    config: ParseConfig,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """table_from_box (n, 4, 4) of objects of half sizes (n, 3) by the prior, and which of them float (n,)."""
    support = _support(camera_from_table)
    prior = pose_prior([support], prior_space(support, np.zeros((0, 3))), config)
    movable = np.arange(len(half_m) + 1) < len(half_m)
    bodies = Bodies(
        jnp.asarray(np.concatenate([half_m, half_sizes([support])])),
        jnp.asarray(movable),
        jnp.asarray(movable[:, None] | (np.arange(6) == TOP_FACE)),
    )
    slabs = slabs_under([support], np.asarray(np.linalg.inv(camera_from_table), np.float64))
    scene = drawn_scene(rng, prior, bodies, slabs, config.floating_weight)
    return matrices_of(np.asarray(scene.poses, np.float64)[:-1]), np.asarray(scene.parents)[:-1] == ROOT


def _is_possible(objects: Sequence[SceneObject], table_from_box: NDArray[np.float64], sunk_m: float) -> bool:
    """Whether objects at poses (n, 4, 4) enter neither each other nor the table, but for `sunk_m`."""
    heights_m = [
        pose[2, :3] @ one.points_m.T + pose[2, 3] for one, pose in zip(objects, table_from_box, strict=True)
    ]
    if min(height_m.min() for height_m in heights_m) < -sunk_m:
        return False
    placed = [(one, pose[None]) for one, pose in zip(objects, table_from_box, strict=True)]
    return not any(meet(*first, *second).any() for first, second in combinations(placed, 2))


def _is_in_sight(camera_from_box: NDArray[np.float64]) -> bool:
    """Whether the middles of objects (n, 4, 4) project into the image."""
    return bool(pixels_at(camera_from_box[:, :3, 3], intrinsics(), (HEIGHT, WIDTH))[2].all())


def _lies(one: SceneObject, table_from_box: NDArray[np.float64], config: ParseConfig) -> bool:
    """Whether an object at a pose (4, 4) lies in one of its stable ways, as far as contacts are flush."""
    off = np.arccos(np.clip(-one.rests @ table_from_box[2, :3], -1, 1)).min()
    return bool(off < FLUSH_SIGMAS / np.sqrt(config.contact_concentration))


def _camera_from_table(rng: np.random.Generator) -> NDArray[np.float64]:
    """A camera that looks at the middle of the table, from any side."""
    elevation = np.radians(rng.uniform(*ELEVATIONS_DEG))
    table_from_camera = np.eye(4)
    down = Rotation.from_euler("x", -np.pi / 2 - elevation)
    about = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi))
    table_from_camera[:3, :3] = (about * down).as_matrix()
    table_from_camera[:3, 3] = -DISTANCE_M * table_from_camera[:3, 2]
    return np.asarray(np.linalg.inv(table_from_camera), np.float64)


def _support(camera_from_table: NDArray[np.float64]) -> SupportPlane:
    return SupportPlane(camera_from_table=camera_from_table, half_size_m=TABLE_HALF_M, bend=np.zeros(6))


def _blank() -> NDArray[np.float32]:
    return np.zeros((HEIGHT, WIDTH), np.float32)
