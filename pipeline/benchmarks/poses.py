"""Poses of known objects on synthetic tables: ours, ours without a graph (3DP3*), and registration peers.

Only depth is given. Peers get the points over the true table plane, or those of the object alone (its true
mask); their settings are chosen on other tables.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import trimesh

from pipeline.benchmarks.learned_objects import Sought
from pipeline.benchmarks.pose_figures import Judged
from pipeline.benchmarks.pose_presence import Reported
from pipeline.benchmarks.pose_tables import FilmedTable, make_table, observed_points
from pipeline.evaluation.object_poses import add_s_m, model_points
from pipeline.evaluation.scenes import ObjectError, object_errors, parents_right
from pipeline.peers.registration import Model, Register, settings
from pipeline.timing import Timing, timed
from recordings.truth import TrueObject
from recordings.types import DepthNoise
from scene.config import ParseConfig
from scene.parsing import parse_scene
from scene.result import SceneResult

OURS = {"voxscene": ParseConfig(), "3DP3* (fixed graph)": ParseConfig(graph="fixed")}
TUNING_SEED, TUNING_TABLES = 900_000, 2
TUNING_S = 15.0
"""Time that a peer's settings get on the tuning tables, all of them on the same objects."""
FEWEST_POINTS = 60
GROWTH_TABLES = 3
GROWTH_SEED = 800_000


@dataclass(frozen=True)
class Peer:
    """A registration method: its name among `settings()`, and whether it gets true masks."""

    name: str
    masked: bool


PEERS = {
    "FPFH + RANSAC + ICP": Peer("fpfh", masked=False),
    "FPFH + RANSAC + ICP, true masks": Peer("fpfh", masked=True),
    "24-start ICP": Peer("icp24", masked=False),
    "24-start ICP, true masks": Peer("icp24", masked=True),
}


class PoseBench:
    """The bench over a set of meshes."""

    def __init__(
        self,
        meshes: Mapping[str, trimesh.Trimesh],
        objects: int,
        seed: int,
        sought: Callable[[str, trimesh.Trimesh], Sought],
    ) -> None:
        """Prepare the meshes for every method.

        Args:
            meshes: by name; tables draw from them.
            objects: on each table.
            seed: of the first table.
            sought: what is looked for in place of a mesh.
        """
        self._meshes, self._count, self._seed = meshes, objects, seed
        self._sought, self._make = {}, sought
        self._models = {name: Model.of(mesh) for name, mesh in meshes.items()}

    def tuned(self, peers: Sequence[str]) -> dict[str, str]:
        """The setting of each peer that does best on the tuning tables, in the time that it gets."""
        tables = [
            make_table(self._meshes, self._count, TUNING_SEED + number)
            for number in range(TUNING_TABLES if peers else 0)
        ]
        return {title: self._best_setting(PEERS[title], tables) for title in peers}

    def judge(self, number: int, peers: Mapping[str, str]) -> list[Judged]:
        """Every method's errors on table `number`.

        Args:
            number: of the table.
            peers: names of `PEERS` with their settings.
        """
        table = make_table(self._meshes, self._count, self._seed + number)
        judged = []
        for name, config in OURS.items():
            scene, timing = self._parsed(table, config)
            judged += self._judged(number, table, name, scene, timing.seconds)
        for title, setting in peers.items():
            begun = time.perf_counter()
            errors = self._peer_errors(table, PEERS[title], setting)
            seconds = time.perf_counter() - begun
            judged += [
                _judgement(number, title, setting, one, error, None, seconds)
                for one, error in zip(table.judged, errors, strict=True)
            ]
        return judged

    def growth(self, most: int) -> Iterator[dict[str, Any]]:
        """Seconds of a parse against the number of objects, 1 to `most`, and what was compiled before."""
        for count in range(1, most + 1):
            seconds, compile_s, errors = [], 0.0, []
            for number in range(GROWTH_TABLES):
                table = make_table(self._meshes, count, GROWTH_SEED + number)
                compile_s += self._parsed(table, OURS["voxscene"])[1].compile_s
                scene, timing = self._parsed(table, OURS["voxscene"])
                seconds.append(timing.seconds)
                errors += [one.error_m for one in self._judged(number, table, "", scene, timing.seconds)]
            yield {
                "objects": count,
                "seconds": float(np.median(seconds)),
                "compile_s": compile_s,
                "under_1cm": float(np.mean(np.array(errors) < 0.01)) if errors else None,
            }

    def presences(self, number: int, absent: int) -> list[Reported]:
        """What is said on table `number` if of its objects so many others are asked for in the place of some.

        The prior told is the share of those asked for that are there; those of which too little is seen
        do not count.
        """
        table = make_table(self._meshes, self._count, self._seed + number)
        names, rng = _shapes(table), np.random.default_rng([self._seed + number, absent])
        others = [name for name in sorted(self._meshes) if name not in names]
        swapped = min(absent, len(names), len(others))
        asked = sorted({*rng.permutation(names)[swapped:], *rng.permutation(others)[:swapped]})
        share = np.clip(1 - swapped / len(asked), 0.1, 0.9)
        scene, _ = self._parsed(table, ParseConfig(presence=float(share)), asked)
        errors = {one.name: one.add_s_m for one in self._errors(table, scene)}
        judged = {one.shape: errors[one.name] for one in table.judged}
        return [
            Reported(
                shape=name,
                presence=float(presence),
                there=name in judged,
                error_m=judged.get(name, np.inf),
            )
            for name, presence in zip(scene.names.tolist(), scene.presence, strict=True)
            if name in judged or name not in names
        ]

    def _errors(self, table: FilmedTable, scene: SceneResult) -> list[ObjectError]:
        truth = table.recording.truth.objects
        frames = {name: one.shape_from_object for name, one in self._sought.items()}
        return object_errors(truth, self._meshes, table.camera_from_world, scene.found_poses, frames)

    def _parsed(
        self, table: FilmedTable, config: ParseConfig, names: Sequence[str] | None = None
    ) -> tuple[SceneResult, Timing]:
        """The scene of the table's own objects or those named, and the time that it took."""
        names = _shapes(table) if names is None else names
        for name in names:
            if name not in self._sought:
                self._sought[name] = self._make(name, self._meshes[name])
        with timed() as timing:
            scene = parse_scene(
                jax.random.key(self._seed),
                [table.frame],
                [0],
                np.eye(4)[None],
                table.recording.intrinsics,
                DepthNoise(),
                [self._sought[name].scene_object for name in names],
                config,
            )
        return scene, timing

    def _judged(
        self, number: int, table: FilmedTable, method: str, scene: SceneResult, seconds: float
    ) -> list[Judged]:
        by_name = {error.name: error.add_s_m for error in self._errors(table, scene)}
        parents = parents_right(scene, table.recording.truth.objects)
        return [
            _judgement(number, method, "", one, by_name[one.name], parents.get(one.name), seconds)
            for one in table.judged
        ]

    def _peer_errors(self, table: FilmedTable, peer: Peer, setting: str) -> list[float]:
        """Errors of the objects that are judged, in their order."""
        points = observed_points(table, self._meshes, masked=peer.masked)
        register = settings()[peer.name][setting]
        pairs = zip(table.recording.truth.objects, points, strict=True)
        judged = {one.name for one in table.judged}
        return [self._peer_error(table, one, register, seen) for one, seen in pairs if one.name in judged]

    def _peer_error(
        self, table: FilmedTable, one: TrueObject, register: Register, points: np.ndarray
    ) -> float:
        estimate = register(self._models[one.shape], points) if len(points) >= FEWEST_POINTS else None
        pose = table.camera_from_world @ one.world_from_object
        return add_s_m(model_points(self._meshes[one.shape]), pose, estimate)

    def _best_setting(self, peer: Peer, tables: Sequence[FilmedTable]) -> str:
        """The setting with the least mean error, 10 cm at most each, over the objects there was time for."""
        begun = time.perf_counter()
        registers = settings()[peer.name]
        scores: dict[str, list[float]] = {setting: [] for setting in registers}
        for table in tables:
            points = observed_points(table, self._meshes, masked=peer.masked)
            for one, seen in zip(table.recording.truth.objects, points, strict=True):
                if one in table.judged and time.perf_counter() - begun < TUNING_S:
                    for setting, register in registers.items():
                        scores[setting].append(min(self._peer_error(table, one, register, seen), 0.1))
        return min(scores, key=lambda setting: float(np.mean(scores[setting] or [0.0])))


def _shapes(table: FilmedTable) -> list[str]:
    return list(dict.fromkeys(one.shape for one in table.recording.truth.objects))


def _judgement(
    number: int,
    method: str,
    setting: str,
    one: TrueObject,
    error_m: float,
    parent_right: bool | None,
    seconds: float,
) -> Judged:
    return Judged(
        method=method,
        setting=setting,
        table=number,
        shape=one.shape,
        error_m=error_m,
        visible_fraction=one.visible_fraction or 0.0,
        stacked=one.parent != "table",
        flush=one.contact_faces is not None,
        parent_right=parent_right,
        seconds=seconds,
    )
