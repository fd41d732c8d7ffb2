"""Single images in which objects are hard to find: alone, stacked, cut by the border, hidden by another.

The kinds are those of the supplement's section D. Objects are put down by `placement`; the camera is drawn,
and steered where the kind asks for a visible fraction, until the image has what its kind wants.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.errors import PipelineError
from pipeline.synthesis.colours import muted_colour
from pipeline.synthesis.filming import FIRST_STAMP_NS, clutter_parts, film_along, object_part, true_object
from pipeline.synthesis.furniture import table
from pipeline.synthesis.paths import PathConfig, camera_path
from pipeline.synthesis.placement import Table, rest_on_table
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.resting import RestingObject
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import CameraConfig, SyntheticScene
from pipeline.synthesis.sensor import DepthSensor
from pipeline.synthesis.solids import surface_of
from pipeline.synthesis.visibility import PixelCounts, Silhouette, pixel_counts, silhouette
from pipeline.synthesis.world import Part, RayCaster
from recordings.truth import TABLE
from recordings.types import CameraIntrinsics, DepthNoise, Trajectory

KINDS: Mapping[str, tuple[float, float]] = {
    "single": (0.95, 1.0),
    "stacked": (0.6, 1.0),
    "partial": (0.2, 0.7),
    "occluded": (0.1, 0.6),
}
"""The kinds of images with the limits of the target's visible fraction."""
DEPTH_UNIT_M = 0.0001
"""Of a stored 1, as in YCB-Video."""
MOST_STORED = 65534
"""Of 16 bits; 65535 reads as saturated."""
BAND = 0.03
"""A wanted visible fraction is met within so much."""
ARRANGEMENTS = 60
"""Arrangements of objects tried for one image."""
CAMERAS = 10
"""Cameras tried for one arrangement."""
WANTED_FOR = 4
"""Arrangements after which any fraction within the limits will do: some are out of a shape's reach."""
PREVIEW = 4
"""The camera is drawn and steered in images so many times smaller."""
STEPS = 9
"""Halvings of the angle by which a camera is steered: to a tenth of a degree."""
CROWDED_AFTER = 15
"""Arrangements after which one object more is to hide the target: a large one needs several."""
TOWERS = 0.25
"""Share of stacks of three."""
BORDER_RAD = np.radians(60.0)
"""Turned by so much, a camera of any usual lens has lost what it looked at."""
BESIDE_RAD = np.radians(60.0)
"""Seen from so far beside the line through both objects, one hides little of the other."""
Wanted = tuple[float, float]
"""A visible fraction, and how far from it will do."""
HIDDEN_BY_OBJECT = 0.9
"""Share of the hidden pixels that another object, and not clutter, must hide."""


@dataclass(frozen=True, kw_only=True)
class ChallengingScene(SyntheticScene):
    """How the images are taken.

    Attributes:
        distance_m: least and largest distance of the camera from the target.
        elevation_deg: least and largest angle of the camera above the target's horizon.
        aim_error_deg: standard deviation of the aim about both image axes.
        visible: limits of the target's visible fraction inside those of its kind; none where empty.
        clutter: things on the table that are none of the shapes.
        spread_m: standard deviation of the objects' places on the table.
        table_radius_m: half the width of the square table.
        table_height_m: height of its top.
    """

    camera: CameraConfig = field(default_factory=lambda: CameraConfig(width=640, height=480))
    sensor: DepthSensor = field(
        default_factory=lambda: DepthSensor(
            quantisation_m=DEPTH_UNIT_M, noise=DepthNoise(max_range_m=MOST_STORED * DEPTH_UNIT_M)
        )
    )
    room: RoomConfig = field(default_factory=lambda: RoomConfig(kind="none"))
    distance_m: tuple[float, float] = (0.6, 1.1)
    elevation_deg: tuple[float, float] = (15.0, 65.0)
    aim_error_deg: float = 3.0
    visible: tuple[float, ...] = ()
    clutter: int = 0
    spread_m: float = 0.06
    table_radius_m: float = 0.45
    table_height_m: float = 0.75

    def __post_init__(self) -> None:
        if not 0 < self.distance_m[0] <= self.distance_m[1]:
            raise ValueError(
                f"distance_m must be two positive distances, nearest first, got {self.distance_m}"
            )
        if not -90 < self.elevation_deg[0] <= self.elevation_deg[1] < 90:
            raise ValueError(f"elevation_deg must be two angles in (-90, 90), got {self.elevation_deg}")
        if self.visible and not (len(self.visible) == 2 and 0 <= self.visible[0] < self.visible[1] <= 1):
            raise ValueError(f"visible must be two shares in [0, 1], lowest first, got {self.visible}")
        if min(self.spread_m, self.table_radius_m, self.table_height_m) <= 0 or self.clutter < 0:
            raise ValueError("spread_m and the table's sizes must be positive, clutter not negative")

    @property
    def support(self) -> Table:
        """The table."""
        return Table(height_m=self.table_height_m, radius_m=self.table_radius_m, spread_m=self.spread_m)

    def limits(self, kind: str) -> tuple[float, float]:
        """Least and largest visible fraction of that kind's target.

        Raises:
            PipelineError: what is asked for lies outside the kind's own limits.
        """
        low, high = KINDS[kind]
        if self.visible:
            low, high = max(low, self.visible[0]), min(high, self.visible[1])
        if low >= high:
            asked = ":".join(f"{share:g}" for share in self.visible)
            raise PipelineError(
                f"--visible {asked} leaves nothing of {kind} images, which show {KINDS[kind][0]:g} to"
                f" {KINDS[kind][1]:g} of their target"
            )
        return low, high


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


@dataclass(frozen=True, eq=False)
class _Arrangement:
    """Objects at rest on the table, and everything that stands there."""

    pile: Sequence[RestingObject]
    target: int
    parts: Sequence[Part]
    caster: RayCaster

    @property
    def target_m(self) -> NDArray[np.float64]:
        """Middle (3,) of the target's bounding box in the world."""
        return (
            self.pile[self.target].vertices_m.min(axis=0) / 2
            + self.pile[self.target].vertices_m.max(axis=0) / 2
        )

    @property
    def others_m(self) -> NDArray[np.float64]:
        """Middle (3,) of the other objects."""
        others = [one.vertices_m for index, one in enumerate(self.pile) if index != self.target]
        return np.mean([(corners.min(axis=0) + corners.max(axis=0)) / 2 for corners in others], axis=0)


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
        for _ in range(CAMERAS if arrangement else 0):
            assert arrangement is not None
            tried += 1
            pose = _CAMERAS[kind](arrangement, scene, (wanted, band), rng)
            if pose is not None and _is_wanted(kind, arrangement, scene, pose, (wanted, band)):
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
) -> _Arrangement | None:
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
    return _Arrangement(pile, [one.shape for one in pile].index(target), parts, RayCaster(parts))


def _looking_at_target(
    arrangement: _Arrangement, scene: ChallengingScene, azimuth_rad: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """A camera (4, 4) in that direction from the target, at a distance and elevation of the scene."""
    path = PathConfig(
        frames=1,
        radius_m=rng.uniform(*scene.distance_m),
        elevations_deg=(rng.uniform(*scene.elevation_deg),),
        start_deg=float(np.degrees(azimuth_rad)),
        look_at_error_deg=scene.aim_error_deg,
    )
    return camera_path(path, arrangement.target_m, rng)[0]


def _any_camera(
    arrangement: _Arrangement, scene: ChallengingScene, wanted: Wanted, rng: np.random.Generator
) -> NDArray[np.float64] | None:
    """In any direction, unless a small image shows already that it is not what is wanted."""
    pose = _looking_at_target(arrangement, scene, rng.uniform(0, 2 * np.pi), rng)
    fraction = _target_counts(arrangement, _preview(scene), pose).visible_fraction
    return pose if abs(fraction - wanted[0]) < 2 * wanted[1] else None


def _camera_that_cuts(
    arrangement: _Arrangement, scene: ChallengingScene, wanted: Wanted, rng: np.random.Generator
) -> NDArray[np.float64] | None:
    """Turned away from the target until the image's border leaves the wanted share of it."""
    straight = _looking_at_target(arrangement, scene, rng.uniform(0, 2 * np.pi), rng)
    direction = rng.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(direction), np.sin(direction), 0.0])
    part, preview = arrangement.parts[arrangement.target], _preview(scene)

    def turned(angle: float) -> NDArray[np.float64]:
        pose = straight.copy()
        pose[:3, :3] @= Rotation.from_rotvec(angle * axis).as_matrix()
        return pose

    def cut(angle: float) -> float:
        alone = silhouette(part, preview, turned(angle))
        inside = alone.in_image(preview.width, preview.height).sum()
        return 1 - float(inside) / max(alone.pixels, 1)

    angle = _where(cut, 1 - wanted[0], BORDER_RAD)
    return None if angle is None else turned(angle)


def _camera_behind_another(
    arrangement: _Arrangement, scene: ChallengingScene, wanted: Wanted, rng: np.random.Generator
) -> NDArray[np.float64] | None:
    """Led round from where the other object hides most until the wanted share of the target shows."""
    towards = arrangement.others_m - arrangement.target_m
    behind, side = np.arctan2(towards[1], towards[0]), rng.choice([-1.0, 1.0])
    state = rng.bit_generator.state

    def beside(angle: float) -> NDArray[np.float64]:
        rng.bit_generator.state = state  # the same distance, elevation and aim at every angle
        return _looking_at_target(arrangement, scene, behind + side * angle, rng)

    def shown(angle: float) -> float:
        return _target_counts(arrangement, _preview(scene), beside(angle)).visible_fraction

    angle = _where(shown, wanted[0], BESIDE_RAD)
    return None if angle is None else beside(angle)


_CAMERAS: Mapping[
    str,
    Callable[[_Arrangement, ChallengingScene, Wanted, np.random.Generator], NDArray[np.float64] | None],
] = {
    "single": _any_camera,
    "stacked": _any_camera,
    "partial": _camera_that_cuts,
    "occluded": _camera_behind_another,
}


def _where(share: Callable[[float], float], wanted: float, largest: float) -> float | None:
    """The angle in [0, largest] at which a growing share is as wanted; None where it is not between them."""
    if not share(0.0) < wanted < share(largest):
        return None
    low, high = 0.0, largest
    for _ in range(STEPS):
        middle = (low + high) / 2
        low, high = (middle, high) if share(middle) < wanted else (low, middle)
    return (low + high) / 2


def _preview(scene: ChallengingScene) -> CameraIntrinsics:
    full = scene.camera.intrinsics
    return full.resized(max(full.width // PREVIEW, 1), max(full.height // PREVIEW, 1))


def _target_counts(
    arrangement: _Arrangement, intrinsics: CameraIntrinsics, pose: NDArray[np.float64]
) -> PixelCounts:
    """Pixels of the target."""
    alone = silhouette(arrangement.parts[arrangement.target], intrinsics, pose)
    return pixel_counts(alone, arrangement.caster.view(intrinsics, pose).part == arrangement.target)


def _is_wanted(
    kind: str, arrangement: _Arrangement, scene: ChallengingScene, pose: NDArray[np.float64], wanted: Wanted
) -> bool:
    """Whether the full image has what its kind asks for."""
    low, high = scene.limits(kind)
    intrinsics = scene.camera.intrinsics
    target = _target_counts(arrangement, intrinsics, pose)
    fraction = target.visible_fraction
    share, band = wanted
    if not low <= fraction <= high or (high - low > 2 * BAND and abs(fraction - share) > band):
        return False
    if kind == "partial":
        return target.shown >= (1 - BAND) * target.inside
    alone = [silhouette(part, intrinsics, pose) for part in arrangement.parts[: len(arrangement.pile)]]
    if not all(one.in_image(intrinsics.width, intrinsics.height).sum() == one.pixels for one in alone):
        return False
    return kind != "occluded" or _hidden_by_objects(arrangement, intrinsics, pose) >= HIDDEN_BY_OBJECT


def _hidden_by_objects(
    arrangement: _Arrangement, intrinsics: CameraIntrinsics, pose: NDArray[np.float64]
) -> float:
    """Share of the target's hidden pixels that show another object."""
    alone: Silhouette = silhouette(arrangement.parts[arrangement.target], intrinsics, pose)
    shown = arrangement.caster.view(intrinsics, pose).part[
        alone.in_image(intrinsics.width, intrinsics.height)
    ]
    hidden = shown[shown != arrangement.target]
    return float((hidden < len(arrangement.pile)).mean()) if len(hidden) else 1.0


def _filmed(
    kind: str,
    arrangement: _Arrangement,
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
