"""Poses of known objects on synthetic tables: ours, ours without a graph (3DP3*), and registration peers.

Tables hold objects at rest, some on others; only depth is given. Peers get the points over the true table
plane, or those of the object alone (its true mask); their settings are chosen on other tables.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.evaluation.object_poses import accuracy, add_s_m, area_under_accuracy, model_points
from pipeline.evaluation.scenes import object_errors, parents_right
from pipeline.peers.registration import Model, Register, settings
from pipeline.synthesis.filming import film_table
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import TableScene
from recordings.types import DepthNoise, Frame
from scene.config import ParseConfig
from scene.observation import unprojected
from scene.parsing import parse_scene
from scene.result import SceneResult
from scene.scene_object import SceneObject, scene_object
from shapes.camera import Camera

STACKED_SHARE = 1 / 3
VISIBLE = 0.25
"""Objects of which less is seen are not judged."""
THRESHOLDS_M = (0.005, 0.01, 0.02)
TUNING_TABLES, FIRST_TUNING_TABLE = 1, 900_000
WARM_UP_TABLE = 950_000
ON_TABLE_M = 0.006
MASK_M = 0.012
FEWEST_POINTS = 60

Report = Callable[[int, int | None], None]
OURS = {"voxscene": ParseConfig(), "3DP3* (fixed graph)": ParseConfig(graph="fixed")}


@dataclass(frozen=True, eq=False)
class Table:
    """One table: its recording of one frame, and that frame."""

    recording: SyntheticRecording
    frame: Frame

    @property
    def camera_from_world(self) -> NDArray[np.float64]:
        """Inverse pose (4, 4) of the camera."""
        return np.linalg.inv(self.recording.trajectory.reference_from_camera[0])


@dataclass(frozen=True, kw_only=True)
class Judged:
    """One method's error on one object.

    Attributes:
        error_m: ADD-S.
        stacked: the object rests on another.
        parent_right: of flush rests, where the method tells parents.
    """

    error_m: float
    stacked: bool
    parent_right: bool | None = None


class PoseBench:
    """The bench over a set of meshes."""

    def __init__(self, meshes: Mapping[str, trimesh.Trimesh], objects: int, seed: int) -> None:
        """Prepare the meshes for every method."""
        self._meshes, self._count, self._seed = meshes, objects, seed
        self._objects: dict[str, SceneObject] = {}
        self._models = {name: Model.of(mesh) for name, mesh in meshes.items()}

    def measure(self, tables: int, report: Report, show: Callable[[str], None]) -> dict[str, Any]:
        """The figures of `tables` tables.

        Args:
            tables: how many.
            report: told how many of how many are done.
            show: given one line a table, as soon as it is known.
        """
        tuned = self._tuned()
        warm_up = self.table(WARM_UP_TABLE)
        for config in OURS.values():
            self._parse(warm_up, config)
        show(f"table  objects; under 1 cm by {', '.join([*OURS, *tuned])}; seconds of voxscene")
        judged: dict[str, list[Judged]] = {}
        seconds: dict[str, list[float]] = {}
        for number in range(tables):
            table = self.table(number)
            before = {name: len(errors) for name, errors in judged.items()}
            for name, config in OURS.items():
                started = time.perf_counter()
                scene = self._parse(table, config)
                seconds.setdefault(name, []).append(time.perf_counter() - started)
                judged.setdefault(name, []).extend(self._judged(table, scene))
            for name, (register, masked) in tuned.items():
                started = time.perf_counter()
                judged.setdefault(name, []).extend(self._peer(table, register, masked))
                seconds.setdefault(name, []).append(time.perf_counter() - started)
            right = [
                sum(one.error_m < 0.01 for one in errors[before.get(name, 0) :])
                for name, errors in judged.items()
            ]
            counted = len(next(iter(judged.values()))) - next(iter(before.values()), 0)
            show(f"{number:>5}  {counted:>7}; {' '.join(map(str, right))}; {seconds['voxscene'][-1]:.2f}")
            report(number + 1, tables)
        return {
            "tables": tables,
            "tuning_tables": TUNING_TABLES,
            "methods": {name: _figures(judged[name], seconds[name]) for name in judged},
        }

    def table(self, number: int) -> Table:
        """Table `number`, the same at each call."""
        scene = TableScene(objects=self._count, stacked_share=STACKED_SHARE, room=RoomConfig(kind="none"))
        recording = film_table(self._meshes, scene, self._seed + number)
        return Table(recording, next(iter(recording)))

    def _parse(self, table: Table, config: ParseConfig) -> SceneResult:
        names = list(dict.fromkeys(one.shape for one in table.recording.truth.objects))
        for name in names:
            if name not in self._objects:
                mesh = self._meshes[name]
                self._objects[name] = scene_object(name, np.asarray(mesh.vertices), np.asarray(mesh.faces))
        return parse_scene(
            jax.random.key(self._seed),
            [table.frame],
            [0],
            np.eye(4)[None],
            table.recording.intrinsics,
            DepthNoise(),
            [self._objects[name] for name in names],
            config,
        )

    def _judged(self, table: Table, scene: SceneResult) -> list[Judged]:
        truth = table.recording.truth.objects
        errors = object_errors(truth, self._meshes, table.camera_from_world, scene.found_poses)
        parents = parents_right(scene, truth)
        return [
            Judged(
                error_m=error.add_s_m,
                stacked=one.parent != "table",
                parent_right=parents.get(one.name) if one.contact_faces else None,
            )
            for one, error in zip(truth, errors, strict=True)
            if (one.visible_fraction or 0) >= VISIBLE
        ]

    def _peer(self, table: Table, register: Register, masked: bool) -> list[Judged]:
        judged = []
        for one, points in zip(table.recording.truth.objects, self._observed(table, masked), strict=True):
            if (one.visible_fraction or 0) < VISIBLE:
                continue
            estimate = register(self._models[one.shape], points) if len(points) >= FEWEST_POINTS else None
            pose = table.camera_from_world @ one.world_from_object
            error = add_s_m(model_points(self._meshes[one.shape]), pose, estimate)
            judged.append(Judged(error_m=error, stacked=one.parent != "table"))
        return judged

    def _observed(self, table: Table, masked: bool) -> list[NDArray[np.float64]]:
        """The points that a peer gets for each object."""
        camera = Camera.from_intrinsics(table.recording.intrinsics)
        points = unprojected(table.frame.depth_m, camera)[table.frame.depth_m > 0]
        world = trimesh.transform_points(points, table.recording.trajectory.reference_from_camera[0])
        truth = table.recording.truth
        assert truth.support_plane is not None
        over = world @ truth.support_plane[:3] + truth.support_plane[3] > ON_TABLE_M
        if not masked:
            return [points[over]] * len(truth.objects)
        distances = np.stack(
            [
                _distance(self._meshes[one.shape], trimesh.transform_points(world, np.linalg.inv(pose)))
                for one in truth.objects
                for pose in [one.world_from_object]
            ]
        )
        owner = np.where(over & (distances.min(axis=0) < MASK_M), distances.argmin(axis=0), -1)
        return [points[owner == index] for index in range(len(truth.objects))]

    def _tuned(self) -> dict[str, tuple[Register, bool]]:
        """Each peer with the setting that does best on the tuning tables."""
        tables = [self.table(FIRST_TUNING_TABLE + number) for number in range(TUNING_TABLES)]
        chosen = {}
        titles = {
            "FPFH + RANSAC + ICP": ("fpfh", False),
            "FPFH + RANSAC + ICP, true masks": ("fpfh", True),
            "24-start ICP": ("icp24", False),
            "24-start ICP, true masks": ("icp24", True),
        }
        for title, (peer, masked) in titles.items():
            scores = {
                setting: np.mean(
                    [min(one.error_m, 0.1) for table in tables for one in self._peer(table, register, masked)]
                )
                for setting, register in settings()[peer].items()
            }
            best = min(scores, key=scores.__getitem__)
            chosen[f"{title} ({best})"] = settings()[peer][best], masked
        return chosen


def _distance(mesh: trimesh.Trimesh, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances (N,) from points to a surface, infinite far from its bounding box."""
    from scipy.spatial import KDTree

    low, high = mesh.bounds
    near = ((points_m > low - MASK_M) & (points_m < high + MASK_M)).all(axis=1)
    distances = np.full(len(points_m), np.inf)
    if near.any():
        distances[near] = KDTree(model_points(mesh)).query(points_m[near])[0]
    return distances


def _figures(judged: Sequence[Judged], seconds: Sequence[float]) -> dict[str, Any]:
    parents = [one.parent_right for one in judged if one.parent_right is not None]
    rows = {
        "all": [one.error_m for one in judged],
        "on the table": [one.error_m for one in judged if not one.stacked],
        "stacked": [one.error_m for one in judged if one.stacked],
    }
    return {
        "rows": {
            row: {
                "objects": len(errors),
                "accuracy": {f"{threshold:g}": accuracy(errors, threshold) for threshold in THRESHOLDS_M},
                "auc_0_10cm": area_under_accuracy(errors),
                "median_m": float(np.median(errors)),
            }
            for row, errors in rows.items()
            if errors
        },
        "parents_right_flush": float(np.mean(parents)) if parents else None,
        "flush_rests": len(parents),
        "seconds_median": float(np.median(seconds)),
        "seconds_most": float(np.max(seconds)),
    }
