"""`bench occlusion`: is a mug there that nobody sees? Supplement L, Fig. 7, against the hidden volume."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.special import expit, logit

from pipeline.atomic import write_table
from pipeline.benchmarks.point_proposals import draws_through_points
from pipeline.benchmarks.seen_object import seen_posterior
from pipeline.evaluation.calibration import PRESENCE_BINS, expected_calibration_error
from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.occlusion import (
    FAR_M,
    HIGH_M,
    LOW_M,
    NOISE,
    PRESENCE,
    SCENES,
    OcclusionScene,
    box_pose,
    hidden_fraction,
    occlusion_camera,
    occlusion_scene,
    random_box_pose,
)
from scene.hidden.depth_evidence import DepthImages, SeenImage
from scene.hidden.hidden_objects import HiddenPosterior, hidden_posterior
from scene.hidden.pose_priors import EulerUniformPoses
from scene.model.number_prior import BinomialNumber
from scene.objects.scene_object import SceneObject, scene_object
from shapes.geometry.camera import Camera

BOX, MUG = "box", "mug"

PRIOR = EulerUniformPoses(low_m=LOW_M, high_m=HIGH_M)


@dataclass(frozen=True, kw_only=True)
class OcclusionRow:
    """One scene.

    Attributes:
        scene: turned, wide, closer, or the number of a random one.
        there: whether the mug is.
        hidden_fraction: of the volume.
        mean_ratio: m, the mean likelihood ratio of the mug over its prior poses.
        mug: probability that it is there, exact but for the number of draws: 9 m / (1 + 9 m).
        mug_error: its standard error.
        effective_draws: of the mug's poses.
        box: probability that the box is there; a lower bound, for one mode of its pose counts.
        seconds: taken.
    """

    scene: str
    there: bool
    hidden_fraction: float
    mean_ratio: float
    mug: float
    mug_error: float
    effective_draws: float
    box: float
    seconds: float


def measure_occlusion(
    seed: int, random_scenes: int, width: int, draws: int, progress: Callable[[int, int], None]
) -> list[OcclusionRow]:
    """The three scenes of the figure and others with the box anywhere; the mug is in none.

    Args:
        seed: of everything.
        random_scenes: how many.
        width: of the images in pixels.
        draws: of the mug's poses in each scene.
        progress: told scenes done and in all.
    """
    meshes, objects = _box_and_mug()
    rng = np.random.default_rng([seed, 1])
    placed = {name: box_pose(yaw_deg, 0.0, away_m) for name, (yaw_deg, away_m) in SCENES.items()}
    placed |= {str(number): random_box_pose(rng) for number in range(random_scenes)}
    rows = []
    for number, (name, pose) in enumerate(placed.items()):
        scene = photographed(name, meshes, {BOX: pose}, width, [seed, number])
        rows.append(occlusion_row(scene, objects, draws, rng))
        progress(number + 1, len(placed))
    return rows


def measure_drawn_scenes(
    seed: int, scenes: int, width: int, draws: int, progress: Callable[[int, int], None]
) -> list[OcclusionRow]:
    """Scenes drawn from the prior, box and mug with it; arguments as `measure_occlusion`.

    The box is told where it is there: what is asked is the mug.
    """
    meshes, objects = _box_and_mug()
    rows = []
    for number in range(scenes):
        rng = np.random.default_rng([seed, 2, number])
        there = [name for name in (BOX, MUG) if rng.uniform() < PRESENCE]
        poses = {name: PRIOR.draw(rng, [objects[name]], 1)[0, 0] for name in there}
        scene = photographed(str(number), meshes, poses, width, [seed, 2, number])
        rows.append(occlusion_row(scene, objects, draws, rng))
        progress(number + 1, scenes)
    return rows


def _box_and_mug() -> tuple[dict[str, trimesh.Trimesh], dict[str, SceneObject]]:
    """Their meshes and shapes by name."""
    meshes = {name: built_in_object(name) for name in (BOX, MUG)}
    return meshes, {name: scene_object(name, mesh.vertices, mesh.faces) for name, mesh in meshes.items()}


def photographed(
    name: str,
    meshes: Mapping[str, trimesh.Trimesh],
    poses: Mapping[str, np.ndarray],
    width: int,
    seed: Sequence[int],
) -> OcclusionScene:
    """An image of some of the meshes."""
    return occlusion_scene(name, meshes, poses, occlusion_camera(width), seed)


def occlusion_row(
    scene: OcclusionScene, objects: Mapping[str, SceneObject], draws: int, rng: np.random.Generator
) -> OcclusionRow:
    """The box's posterior round the truth, then the mug's against draws of it."""
    started = time.perf_counter()
    behind, log_ratio_of_box = evidence_behind(scene, objects[BOX], rng)
    found = mug_posterior(rng, objects[MUG], behind, draws)
    ratio = found.ratios[(0,)]
    return OcclusionRow(
        scene=scene.name,
        there=MUG in scene.camera_from_object,
        hidden_fraction=hidden_fraction(scene),
        mean_ratio=ratio.mean,
        mug=float(found.presence[0]),
        mug_error=float(found.standard_error[0]),
        effective_draws=ratio.effective_draws,
        box=float(expit(logit(PRESENCE) + log_ratio_of_box)),
        seconds=time.perf_counter() - started,
    )


def mug_posterior(
    rng: np.random.Generator, mug: SceneObject, images: DepthImages, draws: int
) -> HiddenPosterior:
    """Of the mug alone, by draws through unexplained points too."""
    draws_of = partial(draws_through_points, rng)
    number = BinomialNumber(PRESENCE)
    return hidden_posterior(rng, [mug], PRIOR, images, number, draws=draws, draws_of=draws_of)


def evidence_behind(
    scene: OcclusionScene, box: SceneObject, rng: np.random.Generator
) -> tuple[DepthImages, float]:
    """The image against draws of the box, where it is there, and the log ratio of its being there."""
    nothing_m = np.full((1, *scene.depth_m.shape), FAR_M, np.float32)
    empty = evidence_against(scene, nothing_m)
    if BOX not in scene.camera_from_object:
        return empty, -np.inf
    seen = seen_posterior(rng, box, scene.camera_from_object[BOX], PRIOR, empty)
    return evidence_against(scene, np.minimum(empty.layers(box, seen.poses), FAR_M)), seen.log_ratio


def evidence_against(scene: OcclusionScene, rest_m: np.ndarray) -> DepthImages:
    """What the image says against renderings (R, H, W) of what is known."""
    image = SeenImage(
        camera=Camera.from_intrinsics(scene.camera),
        camera_from_world=np.eye(4),
        observed_m=scene.depth_m,
        rest_m=rest_m,
    )
    return DepthImages([image], NOISE)


def figures(rows: Sequence[OcclusionRow]) -> dict[str, Any]:
    """The rows, and what Fig. 7 claims of them."""
    by_name = {row.scene: row for row in rows}
    turned, wide, closer = (by_name[name].mug for name in SCENES)
    return {
        "scenes": [asdict(row) for row in rows],
        "in_order": bool(turned < wide < closer),
        "least_box": min(row.box for row in rows),
        "largest_error": max(row.mug_error for row in rows),
    }


def drawn_figures(rows: Sequence[OcclusionRow]) -> dict[str, Any]:
    """The rows, and how often the mug is there of those that it is told of with about some probability."""
    told, there = np.array([row.mug for row in rows]), np.array([row.there for row in rows])
    return {
        "scenes": [asdict(row) for row in rows],
        "there": int(there.sum()),
        "presence_sum": float(told.sum()),
        "ece": expected_calibration_error(told, there, PRESENCE_BINS),
        "largest_error": max(row.mug_error for row in rows),
    }


def write_rows(path: Path, rows: Sequence[OcclusionRow]) -> None:
    """A CSV file, whole or not at all."""
    write_table(path, [field.name for field in fields(OcclusionRow)], map(asdict, rows))
