"""Turns are drawn as their colours say, wherever the chains left them."""

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from scipy.stats import chisquare

from pipeline.meshes import vertex_rgb
from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.paint import painted
from scene.mcmc.colour_turns import SeenColours, turns_of, with_drawn_turns
from scene.mcmc.samples import Samples
from scene.objects.scene_object import SceneObject, scene_object
from shapes.geometry.poses import matrices_of, poses_of

WORLD_FROM_CAMERA = matrices_of(
    np.array([0.9, 0.1, 0.3, 0.2, 0.5, -0.2, 0.7]) / np.array([0.975] * 4 + [1] * 3)
)
SHARES = np.array([0.6, 0.25, 0.1, 0.05])


@dataclass(frozen=True, eq=False)
class Told:
    """In place of an image: what it would say of the four ways in which a box lies."""

    objects: list[SceneObject]
    numbers: np.ndarray
    poses: np.ndarray

    def log_shares(self, found: int, turns: np.ndarray) -> np.ndarray:
        """Log probabilities (4,)."""
        del found
        assert len(turns) == len(SHARES)
        return np.log(SHARES)


def box() -> SceneObject:
    """With a label."""
    bare = built_in_object("box")
    mesh = painted("box", bare, "label")
    rgb = vertex_rgb(mesh)
    one = scene_object("box", np.asarray(bare.vertices), np.asarray(bare.faces))
    return one.coloured(np.asarray(mesh.vertices), np.asarray(mesh.faces), rgb, 2.2)


def drawn_from(
    seed: int, one: SceneObject, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Samples, Samples]:
    """Ways in which the box lies and its matrices afterwards, and the samples before and after.

    Args:
        seed: of the draws.
        one: the box.
        start: (S, chains) ways in which it lies before; the first sample lies elsewhere.
    """
    turns = turns_of(one)
    best = matrices_of(np.array([0.8, 0.6, 0, 0, 0.05, 0.02, 0.6]))
    poses = (WORLD_FROM_CAMERA @ best)[None, None] @ turns[start]
    poses[0, 0, :3, 3] += 0.1
    samples = Samples(
        poses=poses_of(poses)[..., None, :],
        parents=start[..., None].astype(np.int32),
        parent_faces=np.zeros((*start.shape, 1), np.int32),
        child_faces=np.zeros((*start.shape, 1), np.int32),
        log_posterior=np.zeros(start.shape),
        accepted=np.ones(start.shape),
    )
    told = cast("SeenColours", Told([one], np.array([0]), poses_of(best)[None]))
    drawn = with_drawn_turns(np.random.default_rng(seed), told, WORLD_FROM_CAMERA, samples)
    after = matrices_of(cast("Any", drawn.poses)[:, :, 0])
    between = (np.linalg.inv(WORLD_FROM_CAMERA @ best) @ after)[..., :3, :3]
    way = np.einsum("scij,tij->sct", between, turns[:, :3, :3]).argmax(axis=-1)
    return way, after, samples, drawn


def test_where_depth_tells_turns_samples_are_weighed(seed: int) -> None:
    """Ways that depth finds 7 : 1 : 1 : 1 become as told times that; each keeps its own parent.

    No exact test: 1,000 samples are drawn again from 1,000. Shares are within 0.08 of the exact ones, four
    standard deviations of both draws.
    """
    one = box()
    assert one.colour is not None
    one = replace(one, colour=replace(one.colour, exact=False))
    before = np.array([0.7, 0.1, 0.1, 0.1])
    start = np.random.default_rng(seed).choice(4, p=before, size=(500, 2))
    way, _, _, drawn = drawn_from(seed, one, start)
    exact = SHARES * before / (SHARES * before).sum()
    shares = np.bincount(way.ravel(), minlength=4) / way.size
    assert np.abs(shares - exact).max() < 0.08
    assert np.array_equal(drawn.parents[..., 0], way)


def test_turns_are_drawn_from_their_conditional(seed: int) -> None:
    """From samples in all four ways: the ways afterwards are as told (chi-squared, false alarm 1e-4).

    Places are kept to a micrometre: a turn about the middle moves nothing. A sample that lies elsewhere keeps
    its turn.
    """
    start = np.random.default_rng(seed).integers(4, size=(500, 2))
    way, after, samples, drawn = drawn_from(seed, box(), start)
    assert np.array_equal(drawn.poses[0, 0], samples.poses[0, 0])
    assert np.abs(after - matrices_of(cast("Any", samples.poses)[:, :, 0]))[..., :3, 3].max() < 2e-3
    counts = np.bincount(way.ravel()[1:], minlength=4)
    assert chisquare(counts, SHARES * counts.sum()).pvalue > 1e-4
    assert np.allclose(np.exp(drawn.log_posterior.ravel()[1:]), SHARES[way.ravel()[1:]])


def test_what_touches_is_drawn_together(seed: int) -> None:
    """Of two boxes, the second of which stands on the first in some samples, both come from one sample."""
    one = box()
    assert one.colour is not None
    objects = [replace(one, colour=replace(one.colour, exact=False))] * 2
    rng = np.random.default_rng(seed)
    best = np.array([0.8, 0.6, 0, 0, 0.05, 0.02, 0.6])
    turns = turns_of(objects[0])[rng.integers(4, size=(200, 2))]
    poses = poses_of(WORLD_FROM_CAMERA @ matrices_of(best) @ turns)[:, :, None].repeat(2, axis=2)
    poses[..., 4:] += rng.normal(0, 1e-3, (200, 2, 1, 3))
    parents = np.where(rng.random((200, 2, 1)) < 0.3, [[[-1, 0]]], -1).astype(np.int32)
    nothing = np.zeros(parents.shape, np.int32)
    samples = Samples(poses, parents, nothing, nothing, np.zeros((200, 2)), np.ones((200, 2)))
    told = cast("SeenColours", Told(objects, np.array([0, 1]), np.stack([best, best])))
    drawn = with_drawn_turns(rng, told, WORLD_FROM_CAMERA, samples)
    shift = np.asarray(drawn.poses)[..., 0, 4:] - np.asarray(drawn.poses)[..., 1, 4:]
    assert np.abs(shift).max() < 1e-12
    assert set(np.unique(drawn.parents)) == {-1, 0}
    assert len(np.unique(np.asarray(drawn.poses)[..., 0, 4])) < 400
