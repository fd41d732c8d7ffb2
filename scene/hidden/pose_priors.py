"""Where a hidden object may be before the images are looked at."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scene.objects.orientations import resting_rotations
from scene.objects.scene_object import SceneObject
from shapes.geometry.poses import placed_points

POINTS = 128
"""Of an object's surface, that are tested for lying in another's box."""

TOUCHING_M = 0.003
"""Depth to which boxes may enter each other: bounding boxes of rounded things overlap by millimetres."""

MOST_REJECTED = 200
"""Rounds of draws, each of as many as are wanted: no room is where fewer than one in 200 is clear."""


class NoRoomError(ValueError):
    """Nowhere that is known to carry objects an object can stand clear of the others."""


class PosePrior(Protocol):
    """A density of poses of one object, or of two together: of their box frames in the world."""

    def draw(
        self, rng: np.random.Generator, objects: Sequence[SceneObject], count: int
    ) -> NDArray[np.float64]:
        """Poses (n, count, 4, 4) world_from_box of n objects.

        Raises:
            NoRoomError: there is no room for the object.
        """
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class EulerUniformPoses:
    """Supplement L: the box's middle uniform in a cuboid, its Euler angles uniform.

    R = R_z(alpha) R_y(beta) R_x(gamma) with alpha and gamma in [-pi, pi), beta in [-pi/2, pi/2]: the density
    is 1 / (4 pi^3) in angles, 2 / (pi^3 cos beta) in the Haar measure of mass pi^2, not uniform on rotations.

    Attributes:
        low_m, high_m: (3,) corners of the cuboid.
        world_from_cuboid: (4, 4), whose axes the angles are about.

    Raises:
        ValueError: the cuboid has no volume.
    """

    low_m: NDArray[np.float64]
    high_m: NDArray[np.float64]
    world_from_cuboid: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        if not (np.asarray(self.low_m) < np.asarray(self.high_m)).all():
            raise ValueError(f"the volume from {_told(self.low_m)} to {_told(self.high_m)} m holds nothing")

    def draw(
        self, rng: np.random.Generator, objects: Sequence[SceneObject], count: int
    ) -> NDArray[np.float64]:
        """Independent: objects may enter each other, as in the supplement (eq. 6)."""
        shape = len(objects), count
        poses = np.tile(np.eye(4), (*shape, 1, 1))
        angles = np.pi * np.array([1.0, 0.5, 1.0]) * rng.uniform(-1, 1, (*shape, 3))
        poses[..., :3, :3] = _turns(angles)
        poses[..., :3, 3] = rng.uniform(self.low_m, self.high_m, (*shape, 3))
        return self.world_from_cuboid @ poses

    @property
    def volume_m3(self) -> float:
        """Of the cuboid."""
        return float(np.prod(np.asarray(self.high_m) - self.low_m))

    def log_density(self, world_from_box: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density (...) of poses (..., 4, 4), Lebesgue in metres times the Haar measure of mass pi^2."""
        poses = np.linalg.inv(self.world_from_cuboid) @ world_from_box
        places = poses[..., :3, 3]
        inside = ((places >= self.low_m) & (places <= self.high_m)).all(axis=-1)
        cosine = np.hypot(poses[..., 0, 0], poses[..., 1, 0])
        log_rotation = np.log(2 / np.pi**3) - np.log(np.maximum(cosine, 1e-300))
        return np.where(inside, log_rotation - np.log(self.volume_m3), -np.inf)


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedObject:
    """An object whose place is known.

    Attributes:
        shape: the object.
        world_from_box: (4, 4).
    """

    shape: SceneObject
    world_from_box: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Support:
    """A rectangle on which objects stand.

    Attributes:
        world_from_support: (4, 4); the origin is the middle, z points up.
        half_size_m: (2,).
    """

    world_from_support: NDArray[np.float64]
    half_size_m: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class RestingPoses:
    """At rest on a support in one of the object's stable rests, clear of what stands there.

    Each rest is as likely, yaws and places are uniform over the supports' areas.

    Attributes:
        supports: at least one.
        others: objects whose boxes it does not enter.
        in_sight: whether middles (n, 3) are where they are possible; None where all are.
    """

    supports: tuple[Support, ...]
    others: tuple[PlacedObject, ...] = ()
    in_sight: Callable[[NDArray[np.float64]], NDArray[np.bool_]] | None = None

    def draw(
        self, rng: np.random.Generator, objects: Sequence[SceneObject], count: int
    ) -> NDArray[np.float64]:
        """Draws in which one meets another, or what stands there, are made again as a whole."""
        kept = np.zeros((len(objects), 0, 4, 4))
        for _ in range(MOST_REJECTED):
            poses = np.stack([self._anywhere(rng, one, count) for one in objects])
            kept = np.concatenate([kept, poses[:, self._clear(objects, poses)]], axis=1)
            if kept.shape[1] >= count:
                return kept[:, :count]
        names = " and ".join(one.name for one in objects)
        raise NoRoomError(f"there is no room for {names} on what was found to carry objects")

    def _clear(self, objects: Sequence[SceneObject], poses: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(count,) draws in which no object, at poses (n, count, 4, 4), meets any, and all are in sight."""
        clear = np.ones(poses.shape[1], bool)
        for place, one in enumerate(objects):
            if self.in_sight is not None:
                clear &= self.in_sight(poses[place, :, :3, 3])
            standing = [(other.shape, other.world_from_box[None]) for other in self.others]
            for other, where in [*standing, *zip(objects[:place], poses[:place], strict=True)]:
                clear &= ~meet(one, poses[place], other, where)
        return clear

    def _anywhere(self, rng: np.random.Generator, one: SceneObject, count: int) -> NDArray[np.float64]:
        areas = np.array([np.prod(support.half_size_m) for support in self.supports])
        which = rng.choice(len(self.supports), count, p=areas / areas.sum())
        upright = resting_rotations(one.rests, 1)[rng.integers(len(one.rests), size=count)]
        yaws = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi, (count, 1))).as_matrix()
        poses = np.tile(np.eye(4), (count, 1, 1))
        poses[:, :3, :3] = yaws @ upright
        half_m = np.stack([support.half_size_m for support in self.supports])[which]
        poses[:, :2, 3] = half_m * rng.uniform(-1, 1, (count, 2))
        poses[:, 2, 3] = -np.einsum("dj,pj->dp", poses[:, 2, :3], one.points_m).min(axis=1)
        return np.stack([support.world_from_support for support in self.supports])[which] @ poses


def meet(
    one: SceneObject, poses: NDArray[np.float64], other: SceneObject, others: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """(n,) whether two objects at poses (n, 4, 4), or (1, 4, 4), meet: points of one in the other's box."""
    poses, others = np.broadcast_arrays(poses, others)
    apart_m = np.linalg.norm(poses[:, :3, 3] - others[:, :3, 3], axis=1)
    together = apart_m < np.linalg.norm(one.half_extents_m) + np.linalg.norm(other.half_extents_m)
    poses, others = poses[together], others[together]
    met = np.zeros(len(together), bool)
    met[together] = _reaches(one, poses, other, others) | _reaches(other, others, one, poses)
    return met


def _reaches(
    one: SceneObject, poses: NDArray[np.float64], other: SceneObject, others: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """(n,) whether a surface point of the first lies in the second's box."""
    points = placed_points(poses, one.points_m[:POINTS])
    inside = np.abs((points - others[:, None, :3, 3]) @ others[:, :3, :3])
    return np.asarray((inside < other.half_extents_m - TOUCHING_M).all(axis=-1).any(axis=-1))


def _turns(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """R_z(alpha) R_y(beta) R_x(gamma) (..., 3, 3) of angles (..., 3); SciPy's takes 3 us each."""
    (ca, cb, cc), (sa, sb, sc) = (np.moveaxis(f(angles), -1, 0) for f in (np.cos, np.sin))
    rows = [
        [ca * cb, ca * sb * sc - sa * cc, ca * sb * cc + sa * sc],
        [sa * cb, sa * sb * sc + ca * cc, sa * sb * cc - ca * sc],
        [-sb, cb * sc, cb * cc],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def _told(point_m: NDArray[np.float64]) -> str:
    return ",".join(f"{value:g}" for value in np.asarray(point_m))
