"""Detection by Open3D on the host: the support plane, and clusters of points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from recordings.types import DepthNoise
from shapes.depth_noise import standard_deviation

SAMPLED_POINTS = 8000

PLANES, DRAWN_PLANES, REFITS = 6, 400, 3

SMALLEST_SHARE = 0.03
"""A plane with a smaller share of the points is not worth a look."""

LOWEST_M, HIGHEST_M = 0.01, 0.4
"""Heights over a plane at which points speak for things that stand on it."""

FITTED_POINTS = 20000

BEND_M, SETTLED_M = 0.012, 0.003
"""Scales of the robust fit of the bend, first and last."""

BEND_PER_M2 = 0.01
"""Standard deviation of what a camera bends a plane by at its edge, over the squared distance: `WARPED_M` at
two metres. It decides where no point of a view tells the bend."""

NARROWEST_HALF_M, SHORTEST_HALF_M = 0.09, 0.12
"""A plane less than 18 cm wide or 24 cm long is a face of what a hand holds."""

STEEPEST = 0.87
"""Cosine of 30 degrees: what is steeper against the plane that carries most is a wall."""

WARPED_M = 0.04
"""Planes that go on from each other and differ less in height are one, seen warped: cameras bend what is two
metres away by so much, and stairs and shelves are further apart."""

LEAST_TOLERANCE_M = 0.006

CONNECTED_M = 0.05
"""A gap in a plane's points at which another piece of furniture of the same height begins."""

WITHIN = 0.5, 99.5
"""Percentiles between which the points of a rectangle lie: others are flying pixels at its edge."""

TURNS = 45
"""Rectangles that are tried, 2 degrees apart: the best is then at most 2% larger than the least."""

PIECE_POINTS = 5
"""Within `CONNECTED_M` of each other; pieces that a neighbour has taken points from have fewer."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SupportPlane:
    """The table: a rectangle on which objects stand.

    Attributes:
        camera_from_table: (4, 4) float64; the origin is the rectangle's middle, z its upward normal.
        half_size_m: (2,) along x and y.
        bend: (6,) height of the seen surface over the plane, as coefficients of 1, x, y, x^2, xy, y^2:
            depth cameras bend planes by millimetres.
    """

    camera_from_table: NDArray[np.float64]
    half_size_m: NDArray[np.float64]
    bend: NDArray[np.float64]

    def spanning(self, low_m: NDArray[np.float64], high_m: NDArray[np.float64]) -> SupportPlane:
        """The same surface with another rectangle, of which these (2,) are corners in this one's frame."""
        x, y = (low_m + high_m) / 2
        _, by_x, by_y, by_xx, by_xy, by_yy = self.bend
        height = _quadratic(np.array([x, y])) @ self.bend
        slopes = by_x + 2 * by_xx * x + by_xy * y, by_y + by_xy * x + 2 * by_yy * y
        bend = np.array([height, *slopes, by_xx, by_xy, by_yy])
        pose = self.camera_from_table.copy()
        pose[:3, 3] += pose[:3, 0] * x + pose[:3, 1] * y
        return SupportPlane(camera_from_table=pose, half_size_m=(high_m - low_m) / 2, bend=bend)

    def in_table_frame(self, points_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Camera points (..., 3) in the table's frame."""
        rotation, origin = self.camera_from_table[:3, :3], self.camera_from_table[:3, 3]
        return (points_m - origin) @ rotation

    def covers(self, inside_m: NDArray[np.float64], margin_m: float = 0.0) -> NDArray[np.bool_]:
        """Which points (..., 3) of the table's frame are over or under it, or so far beside it."""
        over = np.abs(inside_m[..., :2]) < self.half_size_m + margin_m
        return np.asarray(over.all(axis=-1))

    def heights(self, points_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Heights (...) of camera points (..., 3) over the surface that the camera sees."""
        inside = self.in_table_frame(points_m)
        within = np.clip(inside[..., :2], -self.half_size_m, self.half_size_m)
        return inside[..., 2] - _quadratic(within) @ self.bend


def support_planes(
    points_m: NDArray[np.floating],
    seed: int,
    is_seen: Callable[[SupportPlane], bool],
) -> list[SupportPlane]:
    """The planes that can carry things, that with the most points standing over its own extent first.

    Tops of tables, seats, shelves and the floor: what is wide enough, seen from above, and within
    STEEPEST of the first. Points that lie in one of the planes stand on none.

    Args:
        points_m: (N, 3) in the camera frame.
        seed: of the random samples.
        is_seen: whether the image shows a table where it would be seen; others are cuts through things.
    """
    rng = np.random.default_rng(seed)
    sampled = points_m[rng.permutation(len(points_m))[:SAMPLED_POINTS]].astype(np.float64)
    fitted = points_m[rng.permutation(len(points_m))[:FITTED_POINTS]]
    tables = [_table(members) for members in _planes(sampled, rng)]
    tables = [table for table in tables if _is_wide(table) and is_seen(table)]
    left = np.ones(len(sampled), bool)
    for table in tables:
        left &= ~_lies_in(table, sampled)
    standing = np.array([_count_standing(table, sampled[left]) for table in tables])
    supports: list[SupportPlane] = []
    if standing.max(initial=0) == 0:
        return supports
    for number in np.argsort(-standing, kind="stable").tolist():
        if all(_is_another(tables[number], one) for one in supports):
            supports.append(_settled(tables[number], fitted))
    return supports


def given_support(
    place_m: NDArray[np.floating], normal: NDArray[np.floating], points_m: NDArray[np.floating]
) -> SupportPlane:
    """The support in the plane through a place (3,) with a normal (3,), as far as points (N, 3) lie in it.

    Raises:
        ValueError: fewer than PIECE_POINTS points do.
    """
    upward = np.asarray(normal, np.float64) / np.linalg.norm(normal)
    tolerance_m = np.maximum(LOWEST_M, 2 * standard_deviation(DepthNoise(), points_m[:, 2]))
    members = points_m[np.abs((points_m - place_m) @ upward) < tolerance_m]
    if len(members) < PIECE_POINTS:
        place = ", ".join(f"{value:g}" for value in place_m)
        raise ValueError(f"no measured point lies in the support through ({place})")
    return _settled(_rectangle(members.astype(np.float64), np.asarray(place_m, np.float64), upward), points_m)


def _planes(sampled: NDArray[np.float64], rng: np.random.Generator) -> list[NDArray[np.float64]]:
    """Points (M, 3) of each of the largest planes, each without those of the ones before."""
    rest, planes = sampled, []
    fewest = max(int(SMALLEST_SHARE * len(rest)), 50)
    while len(planes) < PLANES and len(rest) > fewest:
        inliers = _plane_inliers(rest, rng)
        if len(inliers) < fewest:
            break
        piece = inliers[_largest_piece(rest[inliers], sampled)]
        if len(piece) >= fewest:
            planes.append(rest[piece])
        rest = np.delete(rest, piece, axis=0)
    return planes


def _is_wide(table: SupportPlane) -> bool:
    narrow, wide = np.sort(table.half_size_m)
    return bool(narrow > NARROWEST_HALF_M and wide > SHORTEST_HALF_M)


def joined(
    supports: Sequence[SupportPlane], others: Sequence[SupportPlane], points_m: NDArray[np.float64]
) -> list[SupportPlane]:
    """The supports of a scene with those that another view of it shows, all in one frame.

    What goes on from one of them widens it, as far as points (N, 3) of that view lie in it; others join them.
    """
    if not supports:
        return list(others)
    every, upward = list(supports), supports[0].camera_from_table[:3, 2]
    for other in others:
        if upward @ other.camera_from_table[:3, 2] <= STEEPEST:
            continue
        same = [number for number, one in enumerate(every) if not _is_another(other, one)]
        if not same:
            every.append(other)
            continue
        known = every[same[0]]
        flat = known.in_table_frame(points_m[_lies_in(other, points_m)])[:, :2]
        if len(flat):
            low, high = np.percentile(flat, WITHIN, axis=0)
            half = known.half_size_m
            every[same[0]] = known.spanning(np.minimum(low, -half), np.maximum(high, half))
    return every


def as_seen(support: SupportPlane, points_m: NDArray[np.floating]) -> SupportPlane:
    """The support with its bend as another view shows it, of which these are points (N, 3) in its camera."""
    return _settled(support, points_m[:: max(1, len(points_m) // FITTED_POINTS)])


def _lies_in(table: SupportPlane, points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (N, 3) are as near to a table's surface as warps of it are."""
    inside = table.in_table_frame(points_m)
    return table.covers(inside) & (np.abs(inside[:, 2]) < LOWEST_M)


def _is_another(table: SupportPlane, first: SupportPlane) -> bool:
    """Whether a plane is no part of another one, which a camera sees warped, and no wall to it."""
    level = table.camera_from_table[:3, 2] @ first.camera_from_table[:3, 2] > STEEPEST
    middle = first.in_table_frame(table.camera_from_table[:3, 3])
    beside = np.maximum(np.abs(middle[:2]) - first.half_size_m, 0).max()
    return bool(level and (abs(middle[2]) > WARPED_M or beside > CONNECTED_M + table.half_size_m.max()))


def _plane_inliers(points_m: NDArray[np.floating], rng: np.random.Generator) -> NDArray[np.int64]:
    """Rows of the points in the best plane, by MSAC (Torr and Zisserman 2000) and a least-squares fit.

    A point lies in a plane within two standard deviations of the sensor, at least LEAST_TOLERANCE_M.
    Open3D's own search runs on several threads, which makes its draws depend on their order.
    """
    corners = points_m[rng.integers(len(points_m), size=(DRAWN_PLANES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 0] / lengths[lengths > 0, None]
    offsets = np.sum(normals * corners[lengths > 0, 0], axis=1)
    tolerance_m = np.maximum(LEAST_TOLERANCE_M, 2 * standard_deviation(DepthNoise(), points_m[:, 2]))
    costs = [
        np.minimum(((points_m @ normal - offset) / tolerance_m) ** 2, 1).sum()
        for normal, offset in zip(normals, offsets, strict=True)
    ]
    if not costs:
        return np.zeros(0, np.int64)
    best = int(np.argmin(costs))
    normal, offset = normals[best], offsets[best]
    for _ in range(REFITS):
        members = points_m[np.abs(points_m @ normal - offset) < tolerance_m]
        middle, normal = _fitted_plane(members)
        offset = normal @ middle
    return np.flatnonzero(np.abs(points_m @ normal - offset) < tolerance_m)


def _largest_piece(members: NDArray[np.float64], points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (M,) of a plane belong to its largest connected piece.

    What stands before a table does not part it: where a point of (N, 3) hides the plane it is taken to go on,
    from that piece to others too long for an object's face.
    """
    parts = _pieces(members)
    if parts.max() < 0:
        return np.ones(len(members), bool)
    sizes = np.bincount(parts[parts >= 0])
    first, *others = np.argsort(-sizes, kind="stable")
    largest = parts == first
    large = [part for part in others if sizes[part] >= PIECE_POINTS and _is_large(members[parts == part])]
    if not large:
        return largest
    joined = _pieces(np.concatenate([members, _hidden(members, points_m)]))[: len(members)]
    return largest | (np.isin(parts, large) & np.isin(parts, parts[np.isin(joined, joined[largest])]))


def _is_large(members: NDArray[np.float64]) -> bool:
    diagonal_m = np.linalg.norm(np.ptp(members, axis=0))  # spares the fit of the many tiny ones
    return bool(diagonal_m > 2 * SHORTEST_HALF_M and _table(members).half_size_m.max() > SHORTEST_HALF_M)


def _hidden(members: NDArray[np.float64], points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where (H, 3) points hide a plane within the bounds of its members."""
    middle, normal = _fitted_plane(members)
    with np.errstate(divide="ignore"):
        farther = (normal @ middle) / (points_m @ normal)
    hidden = points_m[farther > 1] * farther[farther > 1, None]
    return hidden[((hidden > members.min(axis=0)) & (hidden < members.max(axis=0))).all(axis=1)]


def _pieces(points_m: NDArray[np.floating]) -> NDArray[np.int64]:
    """The piece (N,) that each point belongs to, -1 for strays."""
    return np.asarray(_cloud(points_m).cluster_dbscan(CONNECTED_M, PIECE_POINTS))


def _fitted_plane(members: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A point of the least-squares plane, and its unit normal."""
    middle = members.mean(axis=0)
    return middle, np.linalg.svd(members - middle, full_matrices=False)[2][2]


def clusters(
    points_m: NDArray[np.floating], scales_m: Sequence[float], fewest: int = 10
) -> NDArray[np.float64]:
    """Centres (C, 3) of DBSCAN clusters at several neighbourhood sizes, large clusters first.

    Close objects merge at a coarse scale and come apart at a fine one; sparse ones the other way round.
    """
    centres, sizes = [np.zeros((0, 3))], []
    for scale in scales_m:
        labels = np.asarray(_cloud(points_m).cluster_dbscan(scale, fewest))
        members = [points_m[labels == label] for label in range(labels.max(initial=-1) + 1)]
        centres += [(member.min(axis=0) + member.max(axis=0))[None] / 2 for member in members]
        sizes += [len(member) for member in members]
    return np.concatenate(centres)[np.argsort(-np.array(sizes), kind="stable")]


def _table(members: NDArray[np.float64]) -> SupportPlane:
    """The plane's least-squares fit, its normal towards the camera, its extent that of its points."""
    middle, normal = _fitted_plane(members)
    return _rectangle(members, middle, normal * np.sign(-normal @ middle))


def _rectangle(
    members: NDArray[np.float64], middle: NDArray[np.float64], normal: NDArray[np.float64]
) -> SupportPlane:
    """The plane through a point with a normal, as far as its members (N, 3) reach."""
    rotation, centre, half = least_rectangle(members, middle, normal)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, centre
    return SupportPlane(camera_from_table=pose, half_size_m=half, bend=np.zeros(6))


def least_rectangle(
    members: NDArray[np.float64], middle: NDArray[np.float64], normal: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The least rectangle in the plane through a point with a normal that holds nearly all members (N, 3).

    Its sides are along the frame's but for the turn that makes it least: a square top seen over a corner
    fills half of the rectangle that is not turned.

    Returns:
        Axes (3, 3) as columns, the last one the normal, middle (3,) and half sizes (2,).
    """
    right = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    if np.linalg.norm(right) < 0.1:
        right = np.array([0.0, 1.0, 0.0]) - normal[1] * normal
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(normal, right), normal], axis=1).astype(np.float64)
    flat = (members - middle) @ rotation[:, :2]
    turns = np.linspace(-np.pi / 4, np.pi / 4, TURNS, endpoint=False)
    across = flat @ np.stack([np.cos(turns), np.sin(turns)])
    along = flat @ np.stack([-np.sin(turns), np.cos(turns)])
    lows, highs = np.percentile(np.stack([across, along]), WITHIN, axis=1)
    best = int(np.argmin(np.prod(highs - lows, axis=0)))
    (low, high), turn = (lows[:, best], highs[:, best]), turns[best]
    about = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]])
    rotation = rotation @ about
    return rotation, np.asarray(middle + rotation[:, :2] @ ((low + high) / 2)), (high - low) / 2


def _settled(table: SupportPlane, points_m: NDArray[np.floating]) -> SupportPlane:
    """The same table with its bend, by iterated reweighting: what stands on it does not pull it up.

    A view of one corner tells the bend there alone. Slopes and curvatures have a Gaussian prior, the height
    has none.
    """
    inside = table.in_table_frame(points_m)
    close = table.covers(inside) & (np.abs(inside[:, 2]) < BEND_M)
    terms, height = _quadratic(inside[close, :2]), inside[close, 2]
    at_edge = np.append(0.0, _quadratic(table.half_size_m)[1:])
    prior = np.diag(at_edge / (BEND_PER_M2 * (table.camera_from_table[:3, 3] ** 2).sum()))
    bend = np.zeros(6)
    for scale in np.geomspace(BEND_M, SETTLED_M, 12):
        root = np.sqrt((1 + ((height - terms @ bend) / scale) ** 2) ** -2)
        rows = np.concatenate([terms * root[:, None], scale * prior])
        bend = np.linalg.lstsq(rows, np.append(height * root, np.zeros(6)), rcond=None)[0]
    return replace(table, bend=bend)


def _quadratic(places_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Terms (..., 6) of a quadratic surface at places (..., 2)."""
    x, y = places_m[..., 0], places_m[..., 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def _count_standing(table: SupportPlane, points_m: NDArray[np.floating]) -> float:
    """Points over the table; walls, which face the camera as tables do from above, count less."""
    inside = table.in_table_frame(points_m)
    count = (table.covers(inside) & (inside[:, 2] > LOWEST_M) & (inside[:, 2] < HIGHEST_M)).sum()
    upward = -table.camera_from_table[1, 2]
    return float(count * max(upward, 0.1))


def _cloud(points_m: NDArray[np.floating]) -> o3d.geometry.PointCloud:
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points_m, np.float64)))
