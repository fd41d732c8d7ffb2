"""Things that depth hardly tells apart: of pairs that are asked for one is there, with and without colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import trimesh

from pipeline.benchmarks.pose_images import ImageKey, PoseImage
from pipeline.benchmarks.pose_methods import Parse
from pipeline.benchmarks.pose_sources import filmed_image
from pipeline.benchmarks.presence_figures import RIGHT_M, VISIBLE
from pipeline.evaluation.intervals import wilson_interval
from pipeline.meshes import vertex_rgb
from pipeline.synthesis.filming import film_table
from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.paint import painted
from pipeline.synthesis.paths import PathConfig
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import TableScene
from recordings.truth import TrueObject
from scene.config import ParseConfig
from scene.objects.scene_object import SceneObject, scene_object
from scene.result import SceneResult

PATTERN = {
    "can": "label",
    "box": "label",
    "bottle": "plain",
    "bowl": "plain",
    "bracket": "plain",
    "mug": "plain",
}
"""Of the shapes of which there are pairs."""
TWIN_RAD = 2 * np.pi / 3
"""The other one of a pair has other hues, a third of their circle away."""
INSIDE = 0.8
"""Of two that fit into each other, the smaller one's size."""
PAIRS = 3
"""On a table."""
COLOURS: tuple[Literal["off", "add"], ...] = ("off", "add")


@dataclass(frozen=True)
class Variant:
    """A shape in one of its looks.

    Attributes:
        shape: built in.
        twin: whether it has the other hues.
        small: whether it fits into the shape itself.
    """

    shape: str
    twin: bool = False
    small: bool = False

    @property
    def name(self) -> str:
        """Unique."""
        return f"{self.shape}{' twin' if self.twin else ''}{' small' if self.small else ''}"

    @property
    def mesh(self) -> trimesh.Trimesh:
        """Its surface with its colours, made once a process."""
        return _mesh(self)

    @property
    def sought(self) -> SceneObject:
        """The same, ready to be looked for."""
        return _sought(self)


@lru_cache(maxsize=64)
def _mesh(one: Variant) -> trimesh.Trimesh:
    bare = built_in_object(one.shape)
    bare.apply_scale(INSIDE if one.small else 1.0)
    return painted(one.shape, bare, PATTERN[one.shape], TWIN_RAD * one.twin)


@lru_cache(maxsize=64)
def _sought(one: Variant) -> SceneObject:
    vertices, faces = np.asarray(one.mesh.vertices), np.asarray(one.mesh.faces)
    bare = scene_object(one.name, vertices, faces)
    return bare.coloured(vertices, faces, vertex_rgb(one.mesh), ParseConfig().gamma)


@dataclass(frozen=True, kw_only=True)
class PairRow:
    """What a parse says of a pair.

    Attributes:
        table: its number.
        kind: `colour`, `label` where hues of a print differ too, or `inside`.
        shape: that is there.
        parse: `off` or `add`.
        presence: of the one that is there.
        other: of its lookalike.
        distance_m: of its origin from where it is; infinite where it was not found.
        turn_rad: rotation by which it is off.
        seconds: that the table took.
    """

    table: int
    kind: str
    shape: str
    parse: str
    presence: float
    other: float
    distance_m: float
    turn_rad: float
    seconds: float

    @property
    def name_right(self) -> bool:
        """Whether the one that is there is the more probable one, and found."""
        return self.presence > max(self.other, 0.5)


def judge_table(number: int, seed: int) -> list[PairRow]:
    """What each parse says of the pairs of one table; those of which too little is seen are left out."""
    rng = np.random.default_rng([seed + number, 5])
    pairs = [_pair(shape, rng) for shape in rng.permutation(sorted(PATTERN)).tolist()[:PAIRS]]
    image = _image([there for there, _ in pairs], number, seed)
    asked = [one.sought for pair in pairs for one in sorted(pair, key=lambda one: one.name)]
    truth = {one.shape: one for one in image.objects if (one.visible_fraction or 0) >= VISIBLE}
    rows = []
    for parse in COLOURS:
        config = ParseConfig(colour=parse, presence=0.5)
        scene, timing = Parse(title=parse, config=config, seed=seed).parsed_objects(image, asked)
        presence = dict(zip(scene.names.tolist(), scene.presence.tolist(), strict=True))
        rows += [
            PairRow(
                table=number,
                kind="inside" if there.small != other.small else _kind(there),
                shape=there.name,
                parse=parse,
                presence=presence[there.name],
                other=presence[other.name],
                seconds=timing.seconds,
                **_apart(scene, image, truth[there.name]),
            )
            for there, other in pairs
            if there.name in truth
        ]
    return rows


def _pair(shape: str, rng: np.random.Generator) -> tuple[Variant, Variant]:
    """The one that is there and its lookalike; half of those without a print fit into each other."""
    small = PATTERN[shape] == "plain" and bool(rng.integers(2))
    pair = Variant(shape), Variant(shape, twin=True, small=small)
    return pair if rng.integers(2) else (pair[1], pair[0])


def _kind(one: Variant) -> str:
    return "label" if PATTERN[one.shape] == "label" else "colour"


def _image(there: Sequence[Variant], number: int, seed: int) -> PoseImage:
    path = PathConfig(kind="handheld", frames=1, radius_m=0.8, elevations_deg=(40.0,))
    scene = TableScene(objects=len(there), room=RoomConfig(kind="none"), path=path)
    meshes = {one.name: one.mesh for one in there}
    return filmed_image(ImageKey("table", 0, number), film_table(meshes, scene, seed + number), meshes)


def _apart(scene: SceneResult, image: PoseImage, true: TrueObject) -> dict[str, float]:
    """Distance and rotation between where a thing was found and where it is."""
    found = dict(scene.found_poses)
    if true.shape not in found:
        return {"distance_m": float("inf"), "turn_rad": float(np.pi)}
    pose = image.camera_from_world @ true.world_from_object
    between = np.linalg.inv(pose) @ found[true.shape]
    cosine = np.clip((np.trace(between[:3, :3]) - 1) / 2, -1, 1)
    return {"distance_m": float(np.linalg.norm(between[:3, 3])), "turn_rad": float(np.arccos(cosine))}


def lookalike_figures(rows: Sequence[PairRow]) -> dict[str, Any]:
    """Shares and medians by kind and parse."""
    groups = []
    for kind in ("colour", "label", "inside"):
        for parse in COLOURS:
            mine = [one for one in rows if (one.kind, one.parse) == (kind, parse)]
            right = [one for one in mine if one.name_right]
            near = [one for one in right if one.distance_m < RIGHT_M]
            turns = [one.turn_rad for one in near if one.shape.startswith("can")]
            groups.append(
                {
                    "kind": kind,
                    "parse": parse,
                    "pairs": len(mine),
                    "name_right": len(right),
                    "near": len(near),
                    "can_turn_median_rad": float(np.median(turns)) if turns else None,
                    "cans": len(turns),
                }
            )
    seconds = {
        parse: float(np.median([one.seconds for one in rows if one.parse == parse])) for parse in COLOURS
    }
    return {"lookalikes": groups, "seconds": seconds, "rows": [asdict(one) for one in rows]}


def lookalike_lines(figures: dict[str, Any]) -> list[str]:
    """The figures as a table."""
    lines = ["pairs   colour  asked  name right         under 1 cm  cans' turn"]
    for group in figures["lookalikes"]:
        if not group["pairs"]:
            continue
        low, high = wilson_interval(group["name_right"], group["pairs"])
        turn = group["can_turn_median_rad"]
        lines.append(
            f"{group['kind']:<7} {group['parse']:<6}  {group['pairs']:>5}  {group['name_right']:>4}"
            f" ({low:.0%} to {high:.0%})  {group['near']:>9}"
            + ("" if turn is None else f"  {np.degrees(turn):.1f} degrees of {group['cans']}")
        )
    return [*lines, ", ".join(f"{parse} {spent:.1f} s" for parse, spent in figures["seconds"].items())]
