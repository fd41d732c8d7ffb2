"""Parsed scenes against the truth: how far each object's surface lies from where it really is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import stats

from pipeline.evaluation.object_poses import add_s_m, best_matches, error_figures, model_points
from recordings.truth import TrueObject
from scene.copies import shape_of
from scene.result import TABLE, SceneResult

REGULAR_M2 = 1e-12
"""Added to variances of places, which a square micrometre changes nothing about."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectError:
    """How well one true object was found.

    Attributes:
        name: of the object in the truth.
        add_s_m: error of its pose; `MISSING_M` where it was not found.
        found: an estimate of its shape was matched with it.
        visible_fraction: share of it that the first frame shows, where the truth says so.
        estimate: (4, 4) camera_from_object that was matched with it, of the true object's frame.
    """

    name: str
    add_s_m: float
    found: bool
    visible_fraction: float | None
    estimate: NDArray[np.float64] | None = None


def region_level(
    scene: SceneResult, one: int, middle_m: NDArray[np.float64], camera_from_object: NDArray[np.float64]
) -> float:
    """Level of the normal region of an object's middle that its true middle is on the edge of.

    Args:
        scene: as parsed.
        one: the object.
        middle_m: (3,) in its own frame.
        camera_from_object: (4, 4) where it really is.
    """
    pose = scene.camera_from_object[one]
    off = (camera_from_object[:3, :3] - pose[:3, :3]) @ middle_m + camera_from_object[:3, 3] - pose[:3, 3]
    covariance = scene.covariance_of_point(one, middle_m) + REGULAR_M2 * np.eye(3)
    return float(stats.chi2.cdf(off @ np.linalg.solve(covariance, off), 3))


def object_errors(
    objects: Sequence[TrueObject],
    meshes: Mapping[str, trimesh.Trimesh],
    camera_from_world: NDArray[np.float64],
    estimates: Sequence[tuple[str, NDArray[np.float64]]],
    shape_from_object: Mapping[str, NDArray[np.float64]] | None = None,
) -> list[ObjectError]:
    """Errors of all true objects, in their order; instances of one shape are matched at least cost.

    Args:
        objects: of the truth.
        meshes: true surface by shape, in the object's own frame.
        camera_from_world: (4, 4) of the camera whose frame the estimates are in.
        estimates: shape and camera_from_object (4, 4) of every object that was found.
        shape_from_object: (4, 4) by shape, from the true object's frame to that of the shape that was
            looked for; left out where both are one.
    """
    errors: dict[str, ObjectError] = {}
    for shape in dict.fromkeys(one.shape for one in objects):
        true = [one for one in objects if one.shape == shape]
        points = model_points(meshes[shape])
        to_shape = (shape_from_object or {}).get(shape, np.eye(4))
        poses = [pose @ to_shape for name, pose in estimates if name == shape]
        costs = np.array(
            [
                [add_s_m(points, camera_from_world @ one.world_from_object, pose) for pose in poses]
                for one in true
            ]
        ).reshape(len(true), len(poses))
        matches = dict(best_matches(costs))
        for row, one in enumerate(true):
            error = costs[row, matches[row]] if row in matches else add_s_m(points, np.eye(4), None)
            errors[one.name] = ObjectError(
                name=one.name,
                add_s_m=float(error),
                found=row in matches,
                visible_fraction=one.visible_fraction,
                estimate=poses[matches[row]] if row in matches else None,
            )
    return [errors[one.name] for one in objects]


def parents_right(scene: SceneResult, objects: Sequence[TrueObject]) -> dict[str, bool]:
    """Whether the most probable parent of each object is the true one, where the truth tells it of `objects`.

    Objects of one shape stand for each other: one of them right counts for all.
    """
    shapes = {one.name: one.shape for one in objects} | {TABLE: TABLE}
    names = [*scene.names.tolist(), *scene.supports]
    right: dict[str, bool] = {}
    for one in objects:
        if one.parent not in shapes:
            continue
        copies = [
            scene.edge_probabilities[place]
            for place, name in enumerate(scene.names.tolist())
            if scene.found[place] and shape_of(name, shapes.values()) == one.shape
        ]
        right[one.name] = any(
            edges.max() >= 0.5 and shape_of(names[int(edges.argmax())], shapes.values()) == shapes[one.parent]
            for edges in copies
        )
    return right


def summary_of_errors(errors: Sequence[ObjectError], parents: Mapping[str, bool]) -> dict[str, Any]:
    """The figures that are printed."""
    return {
        "objects": [_plain(one) | {"parent_right": parents.get(one.name)} for one in errors],
        **error_figures([one.add_s_m for one in errors]),
        "parents_right": float(np.mean(list(parents.values()))) if parents else None,
    }


def _plain(one: ObjectError) -> dict[str, Any]:
    return {name: value for name, value in vars(one).items() if name != "estimate"}
