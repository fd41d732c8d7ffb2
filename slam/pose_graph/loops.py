"""Loops: keyframes that see a place again which the camera left long before, though their poses deny it.

Along a path errors add up, and keyframes that see one place may lie farther apart than any gate of the
overlaps is wide. A keyframe is compared with those whose thumbnails of depth resemble its own (after the
ferns of Glocker et al. 2013); registration says whether it is the place, and what way leads from the one to
the other. The ways close the graph of relative poses (Grisetti et al. 2010), from which overlaps are asked
anew.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from numpy.typing import NDArray

from shapes.geometry import pose_gaussian
from shapes.geometry.poses import relative_pose
from slam.keyframes.covisibility import LEAST_HOPS, held_together
from slam.keyframes.keyframe_map import place_distances
from slam.pose_graph.displacements import displaced, in_parts, relative_poses
from slam.pose_graph.gauss_newton import FARTHEST
from slam.pose_graph.overlaps import KeyframeImages
from slam.pose_graph.sparse_gaussian import PoseGraph, damped_step
from slam.registration.alignment import STIFFNESS
from slam.registration.registered import Registration
from slam.registration.search import Searcher

CANDIDATES = 5
"""Search effort: places that a keyframe is compared with."""

DRIFT_SHARE = 0.05
"""Metres and radians by which a camera that went a metre or turned by a radian may have lost its way."""

NEAR_VIEW = 0.3
"""Metres and radians by which two views of one place may be apart without any drift."""

LEAST_COVERED = 0.5
"""Of a keyframe's returns, that the place must show."""

LEAST_SHARE = 0.01
"""Of the precision of translations in the weakest direction: as much as noise of normals passes for along a
bare wall, where a place is found anywhere."""

CLOSING_STEPS = 10
"""Of Gauss-Newton: turns of the path make the way round a loop nonlinear."""


@dataclass(frozen=True, kw_only=True)
class Loops:
    """L pairs of keyframes that see one place.

    Attributes:
        pairs: (L, 2) later and earlier.
        ways: (L, 7) earlier_from_later.
        precisions: (L, 6, 6) of their errors, in the charts there.
    """

    pairs: NDArray[np.int_]
    ways: NDArray[np.float32]
    precisions: NDArray[np.float64]

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.pairs)

    def are_open(self, poses: NDArray[np.float32]) -> bool:
        """Whether some are farther from closing at poses (N, 7) than an optimum is sought."""
        if not len(self):
            return False
        return bool(np.abs(_open(self, poses)).max() > FARTHEST)

    def only(self, chosen: NDArray[np.bool_]) -> Loops:
        """Those that are chosen (L,)."""
        return Loops(pairs=self.pairs[chosen], ways=self.ways[chosen], precisions=self.precisions[chosen])


NO_LOOPS = Loops(
    pairs=np.zeros((0, 2), int), ways=np.zeros((0, 7), np.float32), precisions=np.zeros((0, 6, 6))
)


def find_loops(images: KeyframeImages, graph: PoseGraph, poses: NDArray[np.float32]) -> Loops:
    """Pairs that the graph at poses (N, 7) holds together by a long way only, as registration confirms them.

    The later one of each is not fixed, and is asked for the first time. After a keyframe that closes a loop
    the next ones that its overlaps reach are passed over.
    """
    overlaps = graph.pairs if images.known is None else images.known
    together = held_together(len(poses), overlaps)
    first = max(graph.fixed, images.first_new)
    lengths = way_lengths(poses, overlaps, first)
    pairs, ways, precisions, passed = [], [], [], -1
    for later in range(first, len(poses)):
        if later <= passed:
            continue
        walked = lengths[later - first]
        far = ~together[[later]].toarray()[0] & (np.arange(len(walked)) < later)
        far &= _is_in_reach(poses, poses[later], walked)
        for earlier in _most_alike(images, later, np.nonzero(far)[0]):
            found = _registered(images, poses, later, earlier, together[[earlier]].toarray()[0])
            pose = np.asarray(found.optimum.pose)
            if not (found.is_finite and found.is_unambiguous and found.covered >= LEAST_COVERED):
                continue
            if found.weakest_share < LEAST_SHARE:
                continue
            if _is_in_reach(poses[later][None], pose, walked[earlier : earlier + 1])[0]:
                pairs.append((later, earlier))
                ways.append(np.asarray(relative_pose(poses[earlier], pose)))
                precisions.append(_precision(found))
                passed = later + LEAST_HOPS
                break
    return Loops(
        pairs=np.asarray(pairs, int).reshape(-1, 2),
        ways=np.asarray(ways, np.float32).reshape(-1, 7),
        precisions=np.asarray(precisions, np.float64).reshape(-1, 6, 6),
    )


def _precision(found: Registration) -> NDArray[np.float64]:
    """Laplace's (6, 6), with as many pixels as the spread of their blocks' scores says are independent."""
    precision = np.asarray(found.optimum.layer_precisions, np.float64).sum(axis=0)
    stiff = precision + STIFFNESS * np.eye(6)
    repetition = np.linalg.solve(stiff, np.asarray(found.optimum.score_variance, np.float64))
    return precision / max(1.0, float(np.trace(repetition)) / 6.0)


def closed(graph: PoseGraph, poses: NDArray[np.float32], loops: Loops) -> tuple[NDArray[np.float32], Loops]:
    """Keyframes (N, 7) on the graph's ways, as they are at poses (N, 7), bent so that the loops close.

    Loops that the others leave open are dropped, the widest first. Also those that are left.
    """
    while len(loops):
        bent = _bent(graph, poses, loops)
        widths = np.abs(_open(loops, bent)).max(axis=1)
        if (widths <= NEAR_VIEW).all():
            return bent, loops
        loops = loops.only(np.arange(len(loops)) != np.argmax(widths))
    return poses, loops


def _open(loops: Loops, poses: NDArray[np.float32]) -> NDArray[np.float64]:
    """Coordinates (L, 6) by which loops fail to close at poses (N, 7)."""
    return in_parts(_gaps, *(poses[of] for of in loops.pairs.T), loops.ways)[0]


def _bent(graph: PoseGraph, poses: NDArray[np.float32], loops: Loops) -> NDArray[np.float32]:
    """The least squares of the graph's ways and the loops'."""
    pairs = np.concatenate([graph.pairs, loops.pairs])
    ways = np.concatenate([relative_poses(poses[graph.pairs[:, 1]], poses[graph.pairs[:, 0]]), loops.ways])
    weights = np.concatenate([graph.precision[:, :6, :6], loops.precisions])
    for _ in range(CLOSING_STEPS):
        gaps, jacobians = in_parts(_gaps, poses[pairs[:, 0]], poses[pairs[:, 1]], ways)
        bent = PoseGraph(
            keyframes=len(poses),
            pairs=pairs,
            precision=np.einsum("eia,eij,ejb->eab", jacobians, weights, jacobians),
            gradient=np.einsum("eia,eij,ej->ea", jacobians, weights, gaps),
        )
        poses = displaced(poses, damped_step(bent, STIFFNESS)[0])
    return poses


def way_lengths(poses: NDArray[np.float32], overlaps: NDArray[np.integer], first: int) -> NDArray[np.float64]:
    """How far (N - first, N) it is from keyframes from `first` on to all of (N, 7): metres and radians.

    The shortest way counts, along the path or across overlaps (E, 2): where the camera has come back to a
    known place, errors have added up no farther than since then.
    """
    count = len(poses)
    along = np.stack([np.arange(1, count), np.arange(count - 1)], axis=1)
    ends = np.unique(np.concatenate([along, overlaps]), axis=0).T
    steps = np.add(*_distances(poses[ends[0]], poses[ends[1]]))
    # SciPy takes a step of zero length for no step.
    steps = scipy.sparse.coo_array((np.maximum(steps, np.finfo(float).tiny), ends), shape=(count, count))
    return scipy.sparse.csgraph.dijkstra(steps.tocsr(), directed=False, indices=np.arange(first, count))


def _distances(
    poses: NDArray[np.float32], others: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Metres (n,) and radians (n,) between poses (n, 7) and others (n, 7) or (7,)."""
    shift = np.linalg.norm(poses[:, 4:].astype(np.float64) - others[..., 4:], axis=1)
    cosine = np.abs((poses[:, :4].astype(np.float64) * others[..., :4]).sum(axis=1))
    return shift, 2.0 * np.arccos(np.minimum(cosine, 1.0))


def _is_in_reach(
    poses: NDArray[np.float32], pose: NDArray[np.float32], walked: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether a camera may be at poses (n, 7) that is thought to be at one (7,), having gone so far since."""
    return np.maximum(*_distances(poses, pose)) < DRIFT_SHARE * walked + NEAR_VIEW


def _most_alike(images: KeyframeImages, later: int, earlier: NDArray[np.int_]) -> NDArray[np.int_]:
    """At most `CANDIDATES` of the earlier keyframes, that resemble a later one most."""
    if not len(earlier):
        return earlier
    samples = np.stack([images.keyframe_map.samples[index] for index in earlier])
    distances = place_distances(samples, images.keyframe_map.samples[later][:, 2])
    ranked = np.argsort(distances, kind="stable")[:CANDIDATES]
    return earlier[ranked[np.isfinite(distances[ranked])]]


def _registered(
    images: KeyframeImages,
    poses: NDArray[np.float32],
    later: int,
    earlier: int,
    beside: NDArray[np.bool_],
) -> Registration:
    """A keyframe, sought about where an earlier one stands, among those (N,) beside that one alone."""
    view = images.keyframe_map.surface(later).view
    searcher = Searcher(images.keyframe_map, poses, view, images.noise, LEAST_HOPS).among(beside)
    return searcher.near([poses[earlier]])


@jax.jit
def _gaps(later: jax.Array, earlier: jax.Array, ways: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Of pairs (n, 7) from their ways (n, 7): coordinates (n, 6), derivatives (n, 6, 12) in displacements."""

    def gap(xi: jax.Array, later: jax.Array, earlier: jax.Array, way: jax.Array) -> jax.Array:
        of_later, of_earlier = pose_gaussian.displace(later, xi[:6]), pose_gaussian.displace(earlier, xi[6:])
        return pose_gaussian.coordinates(way, relative_pose(of_earlier, of_later))

    still = jnp.zeros((len(ways), 12))
    return jax.vmap(gap)(still, later, earlier, ways), jax.vmap(jax.jacfwd(gap))(still, later, earlier, ways)
