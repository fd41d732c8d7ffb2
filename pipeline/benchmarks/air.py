"""`bench air`: number, kind and place of things on a table from one colour image, against the truth."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from pipeline.atomic import write_table
from pipeline.errors import PipelineError
from pipeline.evaluation.calibration import expected_calibration_error
from pipeline.evaluation.intervals import wilson_interval
from pipeline.fingerprints import COMPUTES, source_hash
from pipeline.simplification import few_triangles
from pipeline.synthesis.air import AirScene, air_scene, air_world
from scene.colour.camera_view import LONGEST_PX, pooled_image
from scene.colour.lattice import Lattice
from scene.colour.posterior import colour_image, log_posterior
from scene.colour.search import find, find_under_any_lamp
from scene.colour.weighing import FoundScene
from scene.colour.world import Light, TableWorld

SEEN_PX = 12
"""Visible pixels from which a thing is judged (issue's rule: fewer are a speck in 64 pixels)."""
GAMMA = 1.0
"""The images' values are light."""
ECE_BINS = 10
SOURCES_SHOWN = 16
"""Digits of the hash: no two programs share them."""
TOLERANCE_NATS = 2.0
"""By which the truth may score higher than what was found before the search is said to have failed."""


@dataclass(frozen=True, kw_only=True)
class AirRow:
    """One scene.

    Attributes:
        scene: its number, which seeds it.
        size: of the image, WIDTHxHEIGHT.
        lamp: as the bench was asked.
        sources: hash of the program's that decide a row.
        true_kinds: names, in order, with + between.
        found_kinds: likewise.
        least_visible: pixels of the thing that is seen least; -1 on an empty table.
        count_probability: that the method gives to the true number.
        told_probability: of the number that it holds for most probable.
        most_probable: that number.
        score_gap: log density of what was found less that of the truth.
        errors_m: distances of places, things of like kind matched, with + between; empty if kinds differ.
        mug_yaw_errors_rad: likewise, of mugs.
        seconds: taken by the search.
        core_seconds: of one core; less where other programs held it.
    """

    scene: int
    size: str
    lamp: str
    sources: str
    true_kinds: str
    found_kinds: str
    least_visible: int
    count_probability: float
    told_probability: float
    most_probable: int
    score_gap: float
    errors_m: str
    mug_yaw_errors_rad: str
    seconds: float
    core_seconds: float

    @property
    def count_right(self) -> bool:
        """As many things were found as there are."""
        return len(_parts(self.true_kinds)) == len(_parts(self.found_kinds))


def measure_air(
    first: int,
    scenes: int,
    size: tuple[int, int],
    lamp: str,
    path: Path | None,
    progress: Callable[[int, int], None],
) -> dict[str, Any]:
    """Search the scenes one by one; the CSV file is whole after each.

    Args:
        first: number of the first scene.
        scenes: how many.
        size: width and height of the images in pixels; large ones are pooled as `parse` does it.
        lamp: `known`, or each scene has a lamp of its own: the search finds it (`any`) or takes the usual
            one for it (`other`).
        path: of the CSV; scenes that it holds already are not searched again.
        progress: told scenes done and in all.

    Raises:
        PipelineError: the file holds something else, or cannot be written.
    """
    about = {"size": f"{size[0]}x{size[1]}", "lamp": lamp, "sources": _sources()}
    rows = {row.scene: row for row in read_rows(path)} if path else {}
    if path:
        _refuse_others(path, rows.values(), about)
    started = time.perf_counter()
    world = air_world(*size)
    lattice = Lattice.of(searched(world))
    set_up_s = time.perf_counter() - started
    wanted = range(first, first + scenes)
    for number in wanted:
        if number not in rows:
            lit = world if lamp == "known" else replace(world, light=_lamp(number))
            rows[number] = _row(lattice, air_scene(lit, number), number, about)
            if path:
                write_table(
                    path, [field.name for field in fields(AirRow)], [asdict(row) for row in rows.values()]
                )
        progress(number - first + 1, scenes)
    return {"set_up_s": set_up_s, **figures([rows[number] for number in wanted])}


def searched(world: TableWorld) -> TableWorld:
    """The world as `parse` searches it, of few triangles; the images show the whole meshes."""
    kinds = []
    for kind in world.kinds:
        mesh = few_triangles(kind.vertices_m, kind.faces)
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)
        kinds.append(replace(kind, vertices_m=vertices, faces=faces))
    camera = world.camera
    if max(camera.width, camera.height) > LONGEST_PX:
        camera = pooled_image(np.zeros((camera.height, camera.width, 3), np.uint8), camera, GAMMA)[1]
    return replace(world, kinds=tuple(kinds), camera=camera)


def _lamp(number: int) -> Light:
    """From anywhere above; drawn apart from the scene."""
    rng = np.random.default_rng([number, 4])
    up, turn, ambient = rng.uniform([0.1, 0, 0.2], [1, 2 * np.pi, 0.8])
    across = np.sqrt(1 - up**2)
    return Light(direction=(across * np.cos(turn), across * np.sin(turn), up), ambient=ambient)


def _row(lattice: Lattice, scene: AirScene, number: int, about: Mapping[str, str]) -> AirRow:
    image, camera = scene.image, air_world(*scene.image.shape[1::-1]).camera
    if max(camera.width, camera.height) > LONGEST_PX:
        rgb = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
        image = pooled_image(rgb, camera, GAMMA)[0]
    started, core_started = time.perf_counter(), time.process_time()
    if about["lamp"] == "any":
        lattice, found, _ = find_under_any_lamp(lattice, image)
    else:
        found = find(lattice, image)
    seconds, core_seconds = time.perf_counter() - started, time.process_time() - core_started
    world = lattice.world
    truth = log_posterior(world, colour_image(world, image), scene.truth)
    places, yaws = _errors(world, scene, found)
    return AirRow(
        scene=number,
        **about,
        true_kinds=_names(world, scene.truth.kinds),
        found_kinds=_names(world, found.best.scene.kinds),
        least_visible=int(scene.visible.min(initial=10**6)) if len(scene.truth) else -1,
        count_probability=float(found.count[len(scene.truth)]),
        told_probability=float(found.count.max()),
        most_probable=int(found.count.argmax()),
        score_gap=found.best.log_density - truth,
        errors_m="+".join(f"{error:.6f}" for error in places),
        mug_yaw_errors_rad="+".join(f"{error:.4f}" for error in yaws),
        seconds=seconds,
        core_seconds=core_seconds,
    )


def _errors(world: TableWorld, scene: AirScene, found: FoundScene) -> tuple[list[float], list[float]]:
    """Errors of places and of mugs' yaws where kinds are right; things of one kind matched by distance."""
    true, got = scene.truth, found.best.scene
    if sorted(true.kinds.tolist()) != sorted(got.kinds.tolist()):
        return [], []
    apart = np.linalg.norm(true.poses[:, None, :2] - got.poses[None, :, :2], axis=-1)
    unlike = true.kinds[:, None] != got.kinds[None]
    pairs = zip(*linear_sum_assignment(apart + 1e3 * unlike), strict=True)
    places, yaws = [], []
    for one, other in pairs:
        places.append(float(apart[one, other]))
        if world.kinds[true.kinds[one]].turns == 1:
            turn = true.poses[one, 2] - got.poses[other, 2]
            yaws.append(float(np.abs((turn + np.pi) % (2 * np.pi) - np.pi)))
    return places, yaws


def figures(rows: Sequence[AirRow]) -> dict[str, Any]:
    """Shares and quantiles over scenes."""
    seen = [row for row in rows if row.least_visible == -1 or row.least_visible >= SEEN_PX]
    counted = [row for row in rows if row.count_right]
    errors = _numbers(row.errors_m for row in rows)
    yaws = _numbers(row.mug_yaw_errors_rad for row in rows)
    seconds = np.array([row.seconds for row in rows])
    return {
        "scenes": len(rows),
        "count_right": _share([row.count_right for row in rows]),
        "count_right_95": _interval([row.count_right for row in rows]),
        "scenes_all_seen": len(seen),
        "count_right_all_seen": _share([row.count_right for row in seen]),
        "count_right_all_seen_95": _interval([row.count_right for row in seen]),
        "kinds_right_where_count_is": _share([row.true_kinds == row.found_kinds for row in counted]),
        "places": len(errors),
        "place_median_m": _quantile(errors, 0.5),
        "place_95_m": _quantile(errors, 0.95),
        "mug_yaw_median_rad": _quantile(yaws, 0.5),
        "found_at_least_truth": _share([row.score_gap >= -TOLERANCE_NATS for row in rows]),
        "missed_by_search": [row.scene for row in rows if row.score_gap < -TOLERANCE_NATS],
        "count_told": float(np.mean([row.told_probability for row in rows])),
        "count_told_right": _share([row.most_probable == len(_parts(row.true_kinds)) for row in rows]),
        "count_ece": _calibration_error(rows),
        "seconds_median": float(np.median(seconds)),
        "seconds_95": float(np.quantile(seconds, 0.95)),
        "core_seconds_median": float(np.median([row.core_seconds for row in rows])),
        "core_seconds_95": float(np.quantile([row.core_seconds for row in rows], 0.95)),
    }


def _calibration_error(rows: Sequence[AirRow]) -> float:
    """Of the most probable number."""
    told = np.array([row.told_probability for row in rows])
    right = np.array([row.most_probable == len(_parts(row.true_kinds)) for row in rows])
    return expected_calibration_error(told, right, ECE_BINS)


def read_rows(path: Path) -> list[AirRow]:
    """What earlier runs wrote; nothing where there is no file.

    Raises:
        PipelineError: the file holds something else.
    """
    if not path.exists():
        return []
    types = {"int": int, "float": float, "str": str}
    with path.open(newline="", encoding="utf-8") as file:
        try:
            return [
                AirRow(**{field.name: types[str(field.type)](row[field.name]) for field in fields(AirRow)})
                for row in csv.DictReader(file)
            ]
        except (KeyError, ValueError, TypeError) as error:
            raise PipelineError(f"{path} was not written by bench air: {error}") from error


def _sources() -> str:
    """Hash of the program's sources that decide a row."""
    return source_hash(__name__, "pipeline.simplification", within=COMPUTES)[:SOURCES_SHOWN]


def _refuse_others(path: Path, rows: Iterable[AirRow], about: Mapping[str, str]) -> None:
    """Refuse a file with rows that were made otherwise.

    Raises:
        PipelineError: it says what differs.
    """
    for row in rows:
        for name, wanted in about.items():
            if (found := getattr(row, name)) != wanted:
                raise PipelineError(
                    f"{path} holds scene {row.scene} of {name} {found}, not {wanted}: name another file"
                )


def _names(world: TableWorld, kinds: NDArray[np.int64]) -> str:
    return "+".join(sorted(world.kinds[kind].name for kind in kinds))


def _parts(text: str) -> list[str]:
    return text.split("+") if text else []


def _numbers(cells: Any) -> NDArray[np.float64]:
    return np.array([float(part) for cell in cells for part in _parts(cell)])


def _share(right: Sequence[bool]) -> float | None:
    return float(np.mean(right)) if right else None


def _interval(right: Sequence[bool]) -> tuple[float, float] | None:
    return wilson_interval(sum(right), len(right)) if right else None


def _quantile(values: NDArray[np.float64], share: float) -> float | None:
    return float(np.quantile(values, share)) if len(values) else None
