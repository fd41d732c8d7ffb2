"""Single images in which objects are hard to find: alone, stacked, cut by the border, hidden by another.

The kinds are those of the supplement's section D. Objects are put down by `placement`; the camera is drawn,
and steered where the kind asks for a visible fraction, until the image has what its kind wants.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.synthesis.challenging_scene import ChallengingScene
from pipeline.synthesis.challenging_views import BAND, CAMERAS, Arrangement, is_wanted
from pipeline.synthesis.colours import muted_colour
from pipeline.synthesis.filming import FIRST_STAMP_NS, clutter_parts, film_along, object_part, true_object
from pipeline.synthesis.furniture import table
from pipeline.synthesis.placement import rest_on_table
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.solids import surface_of
from pipeline.synthesis.world import Part, RayCaster
from recordings.truth import TABLE
from recordings.types import Trajectory

ARRANGEMENTS = 300
"""Arrangements of objects tried for one image: one in a hundred hides a large box behind small things."""
EACH_ARRANGEMENT = 10
"""Cameras tried for one arrangement."""
WANTED_FOR = 4
"""Arrangements after which any fraction within the limits will do: some are out of a shape's reach."""
CROWDED_AFTER = 15
"""Arrangements after which one object more is to hide the target: a large one needs several."""
TOWERS = 0.25
"""Share of stacks of three."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ChallengingImage:
    """One image with what is true of it.

    Attributes:
        kind: of `KINDS`.
        target: name of the object of which the kind speaks.
        recording: of one frame; its truth holds the objects, the parts of its world begin with them.
        parts: those objects, in the truth's order.
    """

    kind: str
    target: str
    recording: SyntheticRecording
    parts: tuple[Part, ...]


def challenging_image(
    shapes: Mapping[str, trimesh.Trimesh],
    kind: str,
    target: str,
    scene: ChallengingScene,
    seed: Sequence[int],
) -> ChallengingImage:
    """An image of that kind with that shape as its target.

    Args:
        shapes: from which its neighbours are drawn.
        kind: of `KINDS`.
        target: name of its shape.
        scene: how it is taken.
        seed: numbers that make the image.

    Raises:
        PipelineError: no arrangement and camera of those tried gave what the kind wants.
    """
    rng = np.random.default_rng(seed)
    low, high = scene.limits(kind)
    wanted, tried, arranged = low, 0, 0
    for number in range(ARRANGEMENTS):
        if number == 0 or number >= WANTED_FOR:
            wanted = rng.uniform(low, high)
        band = BAND if number < WANTED_FOR else np.inf
        arrangement = _arranged(shapes, kind, target, scene, rng, hiding=1 + number // CROWDED_AFTER)
        arranged += arrangement is not None
        for _ in range(EACH_ARRANGEMENT if arrangement else 0):
            assert arrangement is not None
            tried += 1
            pose = CAMERAS[kind](arrangement, scene, (wanted, band), rng)
            if pose is not None and is_wanted(kind, arrangement, scene, pose, (wanted, band)):
                return _filmed(kind, arrangement, scene, pose, rng)
    if not arranged:
        raise PipelineError(f"{target} finds no place in a {kind} arrangement ({ARRANGEMENTS} tried)")
    raise PipelineError(
        f"no {kind} image shows {low:g} to {high:g} of {target}:"
        f" {tried} cameras tried in {arranged} arrangements"
    )


def unplaceable(shapes: Mapping[str, trimesh.Trimesh], kind: str, scene: ChallengingScene) -> dict[str, str]:
    """Shapes that cannot be the target of a kind, with the reason."""
    refused = {}
    for number, name in enumerate(sorted(shapes)):
        rng = np.random.default_rng([number, *map(ord, kind)])
        if not any(_arranged(shapes, kind, name, scene, rng) for _ in range(ARRANGEMENTS)):
            refused[name] = "cannot be stacked" if kind == "stacked" else "does not come to rest"
    return refused


def _arranged(
    shapes: Mapping[str, trimesh.Trimesh],
    kind: str,
    target: str,
    scene: ChallengingScene,
    rng: np.random.Generator,
    *,
    hiding: int = 1,
) -> Arrangement | None:
    """The target with the neighbours that its kind wants, if they find a place; `hiding` may hide it."""
    others = [name for name in sorted(shapes) if name != target]
    count = {"single": 0, "partial": 0, "occluded": hiding, "stacked": 1 + int(rng.random() < TOWERS)}[kind]
    names = [target, *rng.permutation(others)[:count].tolist()]
    if len(names) == 1 and count:
        return None
    stacked = (len(names) - 1) / len(names) if kind == "stacked" else 0.0
    try:
        pile = rest_on_table(
            [(name, shapes[name]) for name in names], scene.support, rng, stacked_share=stacked
        )
    except PipelineError:
        return None
    width = 2 * scene.table_radius_m
    top = surface_of(table(width, width, scene.table_height_m))
    parts = [object_part(resting) for resting in pile]
    parts.append(Part(name=TABLE, mesh=top, world_from_part=np.eye(4), colour=muted_colour(rng)))
    parts += clutter_parts(scene.clutter, pile, scene.support, rng)
    return Arrangement(pile, [one.shape for one in pile].index(target), parts, RayCaster(parts))


def _filmed(
    kind: str,
    arrangement: Arrangement,
    scene: ChallengingScene,
    pose: NDArray[np.float64],
    rng: np.random.Generator,
) -> ChallengingImage:
    trajectory = Trajectory(times_ns=np.array([FIRST_STAMP_NS]), reference_from_camera=pose[None])
    recording = film_along(
        trajectory,
        scene,
        arrangement.parts,
        [true_object(one) for one in arrangement.pile],
        scene.table_height_m,
        rng,
        int(rng.integers(2**31)),
    )
    return ChallengingImage(
        kind=kind,
        target=arrangement.pile[arrangement.target].name,
        recording=recording,
        parts=tuple(arrangement.parts[: len(arrangement.pile)]),
    )
