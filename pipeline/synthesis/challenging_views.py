"""Cameras for arranged objects: drawn, or steered until a wanted share of the target shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.synthesis.challenging_scene import ChallengingScene
from pipeline.synthesis.paths import PathConfig, camera_path
from pipeline.synthesis.resting import RestingObject
from pipeline.synthesis.visibility import PixelCounts, Silhouette, pixel_counts, silhouette
from pipeline.synthesis.world import Part, RayCaster
from recordings.types import CameraIntrinsics

BAND = 0.03
"""A wanted visible fraction is met within so much."""
PREVIEW = 4
"""The camera is drawn and steered in images so many times smaller."""
STEPS = 9
"""Halvings of the angle by which a camera is steered: to a tenth of a degree."""
BORDER_RAD = np.radians(60.0)
"""Turned by so much, a camera of any usual lens has lost what it looked at."""
BESIDE_RAD = np.radians(60.0)
"""Seen from so far beside the line through both objects, one hides little of the other."""
Wanted = tuple[float, float]
"""A visible fraction, and how far from it will do."""
HIDDEN_BY_OBJECT = 0.9
"""Share of the hidden pixels that another object, and not clutter, must hide."""


@dataclass(frozen=True, eq=False)
class Arrangement:
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


def _looking_at_target(
    arrangement: Arrangement, scene: ChallengingScene, azimuth_rad: float, rng: np.random.Generator
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
    arrangement: Arrangement, scene: ChallengingScene, wanted: Wanted, rng: np.random.Generator
) -> NDArray[np.float64] | None:
    """In any direction, unless a small image shows already that it is not what is wanted."""
    pose = _looking_at_target(arrangement, scene, rng.uniform(0, 2 * np.pi), rng)
    fraction = _target_counts(arrangement, _preview(scene), pose).visible_fraction
    return pose if abs(fraction - wanted[0]) < 2 * wanted[1] else None


def _camera_that_cuts(
    arrangement: Arrangement, scene: ChallengingScene, wanted: Wanted, rng: np.random.Generator
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
    arrangement: Arrangement, scene: ChallengingScene, wanted: Wanted, rng: np.random.Generator
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


CAMERAS: Mapping[
    str,
    Callable[[Arrangement, ChallengingScene, Wanted, np.random.Generator], NDArray[np.float64] | None],
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
    arrangement: Arrangement, intrinsics: CameraIntrinsics, pose: NDArray[np.float64]
) -> PixelCounts:
    """Pixels of the target."""
    alone = silhouette(arrangement.parts[arrangement.target], intrinsics, pose)
    return pixel_counts(alone, arrangement.caster.view(intrinsics, pose).part == arrangement.target)


def is_wanted(
    kind: str, arrangement: Arrangement, scene: ChallengingScene, pose: NDArray[np.float64], wanted: Wanted
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
    arrangement: Arrangement, intrinsics: CameraIntrinsics, pose: NDArray[np.float64]
) -> float:
    """Share of the target's hidden pixels that show another object."""
    alone: Silhouette = silhouette(arrangement.parts[arrangement.target], intrinsics, pose)
    shown = arrangement.caster.view(intrinsics, pose).part[
        alone.in_image(intrinsics.width, intrinsics.height)
    ]
    hidden = shown[shown != arrangement.target]
    return float((hidden < len(arrangement.pile)).mean()) if len(hidden) else 1.0
