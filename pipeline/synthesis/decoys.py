"""Tables with a thing that nobody asks for, into which what is asked for may be laid by mistake.

`face`: a box is asked for and a larger one stands there; `block`: a can, and a block; `carrier`: anything,
and it stands on a block or a drum. Of the first two kinds every other table lacks what is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.synthesis.filming import film_table
from pipeline.synthesis.paths import PathConfig
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.resting import solid
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import TableScene
from pipeline.synthesis.solids import block, cylinder, surface_of

KINDS = ("face", "block", "carrier")
DECOY = "decoy"
BOXY = 0.85
"""Share of its bounding box that the hull of what counts as a box fills."""
ROUND = 0.06
"""How far that share of a can may be from pi / 4, and its sides from each other."""
HEAVIER = 2.2
"""A carrier's box holds so many of what it carries: `placement` stacks the smaller thing on the other one."""
DRAWS = 40
"""Decoys and rests drawn before a table is given up."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DecoyTable:
    """A table on film.

    Attributes:
        kind: of `KINDS`.
        shape: that is asked for.
        there: whether it stands there.
        decoy: surface of the thing that nobody asks for.
        recording: of one frame; its truth holds both things, or the decoy alone.
    """

    kind: str
    shape: str
    there: bool
    decoy: trimesh.Trimesh
    recording: SyntheticRecording


def film_decoy(shapes: Mapping[str, trimesh.Trimesh], number: int, seed: int) -> DecoyTable:
    """The table of a number; kinds, and presence of what is asked for, take turns.

    Raises:
        PipelineError: there is no box or can among the shapes, or they do not come to rest.
    """
    kind = KINDS[number % len(KINDS)]
    there = kind == "carrier" or number // len(KINDS) % 2 == 0
    names = _suitable(shapes, kind)
    rng = np.random.default_rng([seed + number, 7])
    path = PathConfig(kind="handheld", frames=1, radius_m=0.8, elevations_deg=(40.0,))
    for _ in range(DRAWS):
        shape = names[rng.integers(len(names))]
        decoy = _decoy(kind, shapes[shape], rng)
        meshes = {DECOY: decoy} | ({shape: shapes[shape]} if there else {})
        stacked_share = 0.5 if kind == "carrier" else 0.0
        scene = TableScene(
            objects=len(meshes), stacked_share=stacked_share, room=RoomConfig(kind="none"), path=path
        )
        try:
            film = film_table(meshes, scene, int(rng.integers(2**31)))
        except PipelineError:
            continue
        parents = {one.shape: one.parent for one in film.truth.objects}
        if kind != "carrier" or parents[shape] == DECOY:
            return DecoyTable(kind=kind, shape=shape, there=there, decoy=decoy, recording=film)
    raise PipelineError(f"no table of kind {kind} in {DRAWS} draws")


def _suitable(shapes: Mapping[str, trimesh.Trimesh], kind: str) -> list[str]:
    """Names of boxes, of cans, or of all shapes.

    Raises:
        PipelineError: there is none.
    """
    if kind == "carrier":
        return sorted(shapes)
    wanted = _is_box if kind == "face" else _is_can
    names = [name for name, mesh in sorted(shapes.items()) if wanted(mesh)]
    if not names:
        raise PipelineError(f"no {'box' if kind == 'face' else 'can'} among the meshes")
    return names


def _is_box(mesh: trimesh.Trimesh) -> bool:
    return bool(mesh.convex_hull.volume > BOXY * np.prod(mesh.extents))


def _is_can(mesh: trimesh.Trimesh) -> bool:
    """Two sides alike, and a hull as full as a cylinder."""
    least, middle, most = np.sort(mesh.extents)
    alike = min(middle - least, most - middle) < ROUND * middle
    return bool(alike and abs(mesh.convex_hull.volume / np.prod(mesh.extents) - np.pi / 4) < ROUND)


def _decoy(kind: str, mesh: trimesh.Trimesh, rng: np.random.Generator) -> trimesh.Trimesh:
    """A thing that nobody asks for, of sizes that suit what is."""
    sides = np.sort(mesh.extents)
    if kind == "face":
        size = sides * rng.uniform(1.15, 1.7, 3)
    elif kind == "block":
        size = _sides_of_can(sides) * [*rng.uniform(1.0, 1.5, 2), rng.uniform(1.1, 1.8)]
    else:
        width, depth = sides[2] * rng.uniform(1.1, 1.6, 2)
        least_m = HEAVIER * float(np.prod(solid(mesh).extents)) / (width * depth)
        height = max(rng.uniform(0.04, 0.12), least_m)
        if rng.random() < 0.5:
            return _centred(surface_of(cylinder(height, max(width, depth) / 2)))
        size = np.array([width, depth, height])
    return _centred(surface_of(block(*size.tolist())))


def _sides_of_can(sides: NDArray[np.float64]) -> NDArray[np.float64]:
    """Diameter twice, then height, of sides in order of size."""
    return sides if sides[1] - sides[0] < sides[2] - sides[1] else sides[::-1]


def _centred(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return mesh
