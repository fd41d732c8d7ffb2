"""Loops: a camera that turns once round itself, each turn taken for a smaller one, sees where it began."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings.types import DepthNoise
from shapes.geometry.poses import matrices_of, single_precision_poses
from slam.keyframes.depth_view import FINE_CANVAS, view_of_frame
from slam.keyframes.keyframe_map import KeyframeMap, place_distances
from slam.keyframes.surfels import surfel_image
from slam.pose_graph import coarse_to_fine
from slam.pose_graph.coarse_to_fine import optimise_coarse_to_fine
from slam.pose_graph.gauss_newton import GraphOptimum, agreement, optimise
from slam.pose_graph.loops import Loops, closed, find_loops, way_lengths
from slam.pose_graph.overlaps import KeyframeImages, keyframe_detail
from slam.pose_graph.sparse_gaussian import connected_to_first
from tests.slam import box_room

NOISE = DepthNoise()
VIEWS = 17
FIRST = 0.1
"""Radians. What closes the loop has twice the least precision that is asked in its weakest direction; from 0
it has a tenth more, and less by the arithmetic of other processors."""
YAWS = FIRST + 0.4 * np.arange(VIEWS)
DRIFTED = FIRST + (YAWS - FIRST) / 1.05
"""The whole circle is taken for 17 degrees less."""


def _circling(yaws: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) that look outwards from a circle of 30 cm."""
    return np.stack([box_room.pose(0.3 * np.sin(yaw), 0.0, 0.3 * np.cos(yaw), yaw) for yaw in yaws])


@pytest.fixture(scope="module")
def images() -> KeyframeImages:
    """What the camera sees once round, and a view more."""
    keyframe_map, details = KeyframeMap(), []
    for frame in box_room.frames(_circling(YAWS), seed=5):
        view = view_of_frame(frame, box_room.INTRINSICS)
        keyframe_map = keyframe_map.with_keyframe(surfel_image(view, NOISE))
        detailed = view_of_frame(frame, box_room.INTRINSICS, FINE_CANVAS)
        details.append(keyframe_map.pages.hold(keyframe_detail(detailed, NOISE)))
    return KeyframeImages(keyframe_map=keyframe_map, details=details, noise=NOISE)


def _turn(poses: np.ndarray, first: int, second: int) -> float:
    """Radians about the vertical from one view to another."""
    matrices = matrices_of(poses[[first, second]])
    return float(Rotation.from_matrix(matrices[0, :3, :3].T @ matrices[1, :3, :3]).as_rotvec()[1])


def _chained(images: KeyframeImages, yaws: np.ndarray, drifted: np.ndarray) -> GraphOptimum:
    """Keyframes that have drifted, their overlaps with neighbours alone."""
    true, wrong = (
        np.asarray(single_precision_poses(np.linalg.inv(_circling(of[:1])) @ _circling(of)))
        for of in (yaws, drifted)
    )
    whole = images.at(true)
    beside = [of[np.abs(of - index) <= 3] for index, of in enumerate(whole.images_of)]
    optimum = optimise(replace(whole, images_of=beside), true)
    assert optimum is not None
    return replace(optimum, poses=wrong)


def test_a_loop_is_found_and_closed(images):
    """Neighbours alone leave the last view 17 degrees from where it was; the loop less than two."""
    true = YAWS[-1] - YAWS[0] - 2 * np.pi

    alone = _chained(images, YAWS, DRIFTED)
    loops = find_loops(images, alone.graph, alone.poses)

    assert abs(_turn(alone.poses, 0, VIEWS - 1) - true) > np.radians(10)
    assert len(loops) > 0
    assert loops.pairs[:, 0].min() >= VIEWS - 3
    assert abs(_turn(closed(alone.graph, alone.poses, loops)[0], 0, VIEWS - 1) - true) < np.radians(2)


def test_the_whole_map_is_drawn_together(images):
    """A drift of 17 degrees is gone after it, and whoever waits is told why."""
    told: list[str] = []
    drifted = _chained(images, YAWS, DRIFTED).poses

    _, found, loops = optimise_coarse_to_fine(images, drifted, on_phase=told.append)

    assert found is not None
    assert abs(_turn(found.poses, 0, VIEWS - 1) - (YAWS[-1] - YAWS[0] - 2 * np.pi)) < np.radians(0.2)
    assert len(loops) > 0
    assert told == [f"closing a loop over {VIEWS} keyframes"]


def test_a_loop_takes_fixed_keyframes_along(images):
    """Of 17 degrees none is left more than six off, though all but three are fixed: their ways bend."""
    alone = _chained(images, YAWS, DRIFTED)
    tracked = replace(images, known=alone.graph.pairs.astype(np.int32))

    _, found, _ = optimise_coarse_to_fine(tracked, alone.poses, fixed=VIEWS - 3)

    assert found is not None
    off = [_turn(found.poses, 0, view) - (YAWS[view] - YAWS[0]) for view in range(VIEWS)]
    assert np.abs(np.angle(np.exp(1j * np.asarray(off)))).max() < np.radians(6)


def test_keyframes_are_asked_once(images):
    """The last view closes a loop by itself; once it has been asked, too, nothing is left to be compared."""
    alone = _chained(images, YAWS, DRIFTED)

    last = find_loops(replace(images, first_new=VIEWS - 1), alone.graph, alone.poses)

    assert last.pairs[:, 0].tolist() == [VIEWS - 1]
    assert len(find_loops(replace(images, first_new=VIEWS), alone.graph, alone.poses)) == 0


def test_overlaps_that_do_not_agree_hide_no_loop(images):
    """Where the views were drawn to, ends of the way overlap with its start, as wrong walls and one floor."""
    wrong = _chained(images, YAWS, DRIFTED).poses

    graph = agreement(images.at(wrong), wrong)

    assert graph is not None
    assert connected_to_first(graph).all()
    assert len(find_loops(images, graph, wrong)) > 0


def test_ways_of_overlaps_that_do_not_agree_have_precisions(images):
    """Rounding leaves eigenvalues a little below zero; told ones of wrong walls were a few hundred below."""
    wrong = _chained(images, YAWS, DRIFTED).poses

    graph = agreement(images.at(wrong), wrong)

    assert graph is not None
    least = np.linalg.eigvalsh(graph.precision[:, :6, :6])
    assert (least[:, 0] > -1e-9 * least[:, -1]).all()


def _with_wrong(loops: Loops) -> Loops:
    """The first one again, the camera a metre beside."""
    wrong = loops.ways[:1] + np.asarray([[0, 0, 0, 0, 1, 0, 0]], np.float32)
    return Loops(
        pairs=np.concatenate([loops.pairs, loops.pairs[:1]]),
        ways=np.concatenate([loops.ways, wrong]),
        precisions=np.concatenate([loops.precisions, 0.1 * loops.precisions[:1]]),
    )


def test_a_loop_that_the_others_contradict_is_dropped(images):
    """One of three says that the camera stands a metre beside; the ways are as without it."""
    alone = _chained(images, YAWS, DRIFTED)
    loops = find_loops(images, alone.graph, alone.poses)

    poses, left = closed(alone.graph, alone.poses, _with_wrong(loops))

    np.testing.assert_allclose(poses, closed(alone.graph, alone.poses, loops)[0], atol=1e-6)
    np.testing.assert_array_equal(left.ways, loops.ways)


def test_a_loop_that_is_dropped_is_not_told(images, monkeypatch):
    """What is told is known to see the same from then on."""
    alone = _chained(images, YAWS, DRIFTED)
    loops = find_loops(images, alone.graph, alone.poses)
    monkeypatch.setattr(coarse_to_fine, "find_loops", lambda *_: _with_wrong(loops))

    _, _, told = optimise_coarse_to_fine(images, alone.poses)

    np.testing.assert_array_equal(told.ways, loops.ways)


def test_three_quarters_of_a_circle_close_no_loop(images):
    """The last view shows another wall."""
    part = KeyframeImages(
        keyframe_map=images.keyframe_map.only(range(12)), details=images.details[:12], noise=NOISE
    )

    chained = _chained(part, YAWS[:12], DRIFTED[:12])
    assert len(find_loops(part, chained.graph, chained.poses)) == 0


def test_the_way_between_keyframes_is_the_shortest_one():
    """Along a line of 1 m steps, the last of which turns by 0.5 rad, or across an overlap of its ends."""
    matrices = np.stack([box_room.pose(0.0, 0.0, float(z), 0.5 * (z == 8)) for z in range(9)])
    line = np.asarray(single_precision_poses(matrices))
    at_ends = line.copy()
    at_ends[8] = line[0]

    along = way_lengths(line, np.zeros((0, 2), int), first=7)
    across = way_lengths(at_ends, np.asarray([[8, 0], [3, 2]]), first=7)

    np.testing.assert_allclose(
        along, [[7, 6, 5, 4, 3, 2, 1, 0, 1.5], [8.5, 7.5, 6.5, 5.5, 4.5, 3.5, 2.5, 1.5, 0]]
    )
    np.testing.assert_allclose(across, [[7, 6, 5, 4, 3, 2, 1, 0, 7], [0, 1, 2, 3, 4, 5, 6, 7, 0]], atol=1e-12)


def test_a_place_resembles_itself_most(images):
    """Of the views, the first is most like the last but one; an image of nothing is like none."""
    samples = np.stack(images.keyframe_map.samples)

    distances = place_distances(samples[: VIEWS - 3], samples[VIEWS - 1][:, 2])

    assert distances.argmin() in (0, 1)
    assert np.isinf(place_distances(samples, np.full(samples.shape[1], np.nan, np.float32))).all()
