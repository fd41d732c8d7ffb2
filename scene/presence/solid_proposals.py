"""Where unknown boxes and cylinders may be: solids fitted to smooth pieces of what one frame shows.

A piece is what hangs together without a step or a sharp edge. The solids of a piece are the least upright box
that holds it, boxes behind each of its flat faces, and cylinders about the axes to which its normals are
square. What carries things over another support is a box, too. Where an object may be there may be a box of
its size instead.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scene.observation.detection import SupportPlane, least_rectangle
from scene.observation.frame_data import SceneData
from scene.observation.segmentation import height_over_next
from scene.observation.standing import connected
from scene.presence.solids import LEAST_M
from scene.presence.state_mixture import StateMixture

STEP_M, TURN_COSINE = 0.004, 0.97
"""Neighbours belong to one piece that differ by less along the normal and turn by less, 14 degrees: a step is
then two deviations of a structured light sensor at a metre."""
FEWEST_PIXELS = 40
"""Of a piece, and of a face of it: smaller ones have no normals that would tell a turn."""
FACES = 4
"""Of a piece that are looked at: a camera sees three of a box."""
FLAT_COSINE = 0.93
"""Of a face's normals with their mean; sensors turn normals of small windows by some degrees."""
UP = np.array([0.0, 0.0, 1.0])
LEVEL, UPRIGHT = 0.94, 0.35
"""Cosines to the vertical above which a face is a top, and below which it is a side: 20 degrees."""
INSIDE_M = 0.01
"""By which points may stick out of a face's rectangle and still tell how deep the solid behind it is."""
STANDS_M = 0.03
"""What ends so far above its support stands on it, its foot hidden or cut off with the support's pixels."""
SIDE_COSINE = 0.5
"""Normals of a cylinder's wall are squarer to its axis; others belong to its ends."""


def proposed_solids(
    view: SceneData, world_from_camera: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Solids (n, 10), world_from_solid and logs of half sizes, and which are cylinders (n,).

    Args:
        view: the frame.
        world_from_camera: (4, 4); the world's z points up, and things stand on z = 0.
    """
    boxes, cylinders = list(_bodies(view.supports, world_from_camera)), []
    for points_m, normals in _pieces(view, world_from_camera):
        boxes += [_standing_box(points_m), *_boxes_behind_faces(points_m, normals)]
        cylinders += _cylinders(points_m, normals)
    solids = np.array([*boxes, *cylinders]).reshape(-1, 10)
    return solids, np.arange(len(solids)) >= len(boxes)


def boxes_in_place(mixture: StateMixture) -> NDArray[np.float64]:
    """Boxes (N, 10) of the sizes of N objects where these most probably are, down to the support at most.

    What explains an image no better than such a box does is one. Of what is round no cylinder is proposed:
    one of free size fits a real can as well as its mesh, whose errors are taken for independent.

    Args:
        mixture: of the objects.
    """
    best = mixture.log_weights.argmax(axis=1)
    return np.array([_box_on_support(one) for one in mixture.centres[np.arange(len(best)), best]])


def _box_on_support(state: NDArray[np.float64]) -> NDArray[np.float64]:
    """The box (10,) of a state (10,) without what is below z = 0 of one that is nearly upright."""
    rotation = Rotation.from_quat(state[:4], scalar_first=True).as_matrix()
    half_m, middle_m = np.exp(state[7:]), rotation.T @ state[4:7]
    low_m, high_m = middle_m - half_m, middle_m + half_m
    for axis in np.flatnonzero(np.abs(rotation[2]) > LEVEL):
        foot_m = middle_m[axis] - state[6] / rotation[2, axis]
        if rotation[2, axis] > 0:
            low_m[axis] = max(low_m[axis], foot_m)
        else:
            high_m[axis] = min(high_m[axis], foot_m)
    return _solid(rotation, low_m, high_m)


def _bodies(supports: Sequence[SupportPlane], world_from_camera: NDArray[np.float64]) -> Iterator[NDArray]:
    """Boxes (10,) from each support over another one down to that."""
    for support in supports:
        height_m = height_over_next(support, supports)
        if np.isfinite(height_m):
            world_from_table = world_from_camera @ support.camera_from_table
            low_m, high_m = np.append(-support.half_size_m, -height_m), np.append(support.half_size_m, 0.0)
            rotation = world_from_table[:3, :3]
            yield _solid(rotation, *(rotation.T @ world_from_table[:3, 3] + end for end in (low_m, high_m)))


def _pieces(
    view: SceneData, world_from_camera: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Points (P, 3) and normals (P, 3) of each piece, in the world."""
    points_m = view.view.points_m
    normals = np.asarray(view.view.normals, np.float64)

    def joined(one: tuple[slice, ...], other: tuple[slice, ...]) -> NDArray[np.bool_]:
        step_m = np.abs(((points_m[one] - points_m[other]) * normals[one]).sum(axis=-1))
        return (step_m < STEP_M) & ((normals[one] * normals[other]).sum(axis=-1) > TURN_COSINE)

    number = connected(view.foreground & normals.any(axis=-1), joined)
    count = np.bincount(number[number >= 0])
    turn, origin_m = world_from_camera[:3, :3], world_from_camera[:3, 3]
    for piece in np.flatnonzero(count >= FEWEST_PIXELS):
        mine = number == piece
        yield points_m[mine] @ turn.T + origin_m, normals[mine] @ turn.T


def _solid(rotation: NDArray[np.float64], low_m: NDArray[np.float64], high_m: NDArray[np.float64]) -> NDArray:
    """State (10,) of what lies between two corners along the axes (3, 3)."""
    wxyz = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    half_m = np.maximum((high_m - low_m) / 2, LEAST_M)
    return np.concatenate([wxyz, rotation @ ((low_m + high_m) / 2), np.log(half_m)])


def _standing_box(points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """The least upright box (10,) over points (P, 3), down to the support."""
    rotation = least_rectangle(points_m, points_m.mean(axis=0), UP)[0]
    return _solid(rotation, *_on_support(rotation, *np.percentile(points_m @ rotation, [1, 99], axis=0)))


def _on_support(
    rotation: NDArray[np.float64], low_m: NDArray[np.float64], high_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners of which the lower one is on z = 0 if the third axis is vertical and it is near."""
    stands = (np.arange(3) == 2) & np.isclose(rotation[2, 2], 1) & (low_m < STANDS_M)
    foot_m = np.where(stands, 0.0, low_m)
    return foot_m, high_m


def _boxes_behind_faces(points_m: NDArray[np.float64], normals: NDArray[np.float64]) -> Iterator[NDArray]:
    """Boxes (10,) behind the flat faces of a piece, the largest face first.

    Sides of things are mostly upright, but a camera turns a far one by some degrees: such a box is tried
    upright and as it is seen.
    """
    left = np.ones(len(normals), bool)
    for _ in range(FACES):
        if left.sum() < FEWEST_PIXELS:
            return
        tried = normals[left][:: max(left.sum() // FEWEST_PIXELS, 1)]
        normal = tried[(normals[left] @ tried.T > FLAT_COSINE).sum(axis=0).argmax()]
        face = left & (normals @ normal > FLAT_COSINE)
        left &= ~face
        if face.sum() >= FEWEST_PIXELS:
            yield from _boxes_behind(points_m, face, _face_normal(points_m[face], normals[face]))


def _face_normal(points_m: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normal (3,) of the plane through points (P, 3), by least squares; of few rows the mean of theirs."""
    mean = normals.mean(axis=0)
    mean /= np.linalg.norm(mean)
    normal = np.linalg.eigh(np.cov(points_m.T))[1][:, 0]
    agreement = normal @ mean
    return normal * np.sign(agreement) if abs(agreement) > FLAT_COSINE else mean


def _boxes_behind(
    points_m: NDArray[np.float64], face: NDArray[np.bool_], normal: NDArray[np.float64]
) -> Iterator[NDArray]:
    """The box (10,) behind a face as it is seen, and the level or upright one that it nearly is."""
    yield _box_behind(points_m, face, normal)
    if normal[2] > LEVEL:
        yield _box_behind(points_m, face, UP)
    elif abs(normal[2]) < UPRIGHT:
        yield _upright_box_behind(points_m, face, normal)


def _box_behind(
    points_m: NDArray[np.float64], face: NDArray[np.bool_], normal: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The box (10,) behind a face: under a top down to the support, else as deep as its piece is seen."""
    middle_m = points_m[face].mean(axis=0)
    rotation = least_rectangle(points_m[face], middle_m, normal)[0]
    low, high, depths = _extents_behind(points_m @ rotation, face, 2)
    if normal[2] > LEVEL:
        low[2] = high[2] - middle_m[2] / normal[2]
    else:
        low[2] = min(np.percentile(depths, 1), high[2] - 2 * LEAST_M)
    return _solid(rotation, low, high)


def _upright_box_behind(
    points_m: NDArray[np.float64], face: NDArray[np.bool_], normal: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The same (10,) behind a side that is upright."""
    level = np.array([*normal[:2], 0.0]) / np.linalg.norm(normal[:2])
    rotation = np.stack([np.cross(UP, level), -level, UP], axis=1)  # the second axis points into the solid
    low, high, depths = _extents_behind(points_m @ rotation, face, 1)
    low[1], high[1] = high[1], max(np.percentile(depths, 99), high[1] + 2 * LEAST_M)
    return _solid(rotation, *_on_support(rotation, low, high))


def _extents_behind(
    inside_m: NDArray[np.float64], face: NDArray[np.bool_], across: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Corners of a face's rectangle, whose upper one is at its median, and what is behind it along one axis.

    Args:
        inside_m: (P, 3) points of its piece along the axes of the box.
        face: (P,) which are of the face.
        across: the axis across it.
    """
    low, high = np.percentile(inside_m[face], [1, 99], axis=0)
    beside = np.arange(3) != across
    behind = ((inside_m > low - INSIDE_M) & (inside_m < high + INSIDE_M))[:, beside].all(axis=1)
    high[across] = np.median(inside_m[face, across])
    return low, high, inside_m[behind, across]


def _cylinders(points_m: NDArray[np.float64], normals: NDArray[np.float64]) -> Iterator[NDArray]:
    """Cylinders (10,), upright and about the axis to which the normals are squarest.

    On a wall points are centre + radius normal, square to the axis: three unknowns, by least squares.
    """
    for axis in (UP, np.linalg.eigh(normals.T @ normals)[1][:, 0]):
        rotation = np.linalg.svd(axis[:, None])[0][:, [1, 2, 0]]
        rotation[:, 2] = axis
        rotation[:, 0] = np.cross(rotation[:, 1], axis)
        wall = np.abs(normals @ axis) < SIDE_COSINE
        if wall.sum() < FEWEST_PIXELS:
            continue
        flat, outward = points_m[wall] @ rotation[:, :2], normals[wall] @ rotation[:, :2]
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        terms = np.concatenate([np.eye(2)[None].repeat(len(flat), axis=0), outward[:, :, None]], axis=2)
        x, y, radius = np.linalg.lstsq(terms.reshape(-1, 3), flat.ravel(), rcond=None)[0]
        if radius < LEAST_M:
            continue
        low, high = np.percentile(points_m @ axis, [1, 99])
        ends = [x - radius, y - radius, low], [x + radius, y + radius, high]
        yield _solid(rotation, *_on_support(rotation, *(np.array(end) for end in ends)))
