"""Turns are drawn as their colours say, wherever the chains left them."""

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from scipy.stats import chisquare

from pipeline.meshes import vertex_rgb
from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.paint import painted
from scene.mcmc.colour_turns import SeenColours, turns_of, with_drawn_turns
from scene.mcmc.sampling import Samples
from scene.model.contact import FACE_AXES, FACE_SIGNS
from scene.model.scene_graph import ROOT
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
        start: (S, chains) ways in which it lies before, on a support and under another object; the first
            sample lies elsewhere.
    """
    turns = turns_of(one)
    best = matrices_of(np.array([0.8, 0.6, 0, 0, 0.05, 0.02, 0.6]))
    poses = (WORLD_FROM_CAMERA @ best)[None, None] @ turns[start]
    poses[0, 0, :3, 3] += 0.1
    own, others = poses_of(poses)[..., None, :], np.tile([1.0, 0, 0, 0, 0, 0, 0], (*start.shape, 2, 1))
    samples = Samples(
        poses=np.concatenate([own, others], axis=2),
        parents=np.tile(np.array([2, 0, ROOT], np.int32), (*start.shape, 1)),
        parent_faces=np.tile(np.array([5, 3, 0], np.int32), (*start.shape, 1)),
        child_faces=np.tile(np.array([4, 1, 0], np.int32), (*start.shape, 1)),
        log_posterior=np.zeros(start.shape),
        accepted=np.ones(start.shape),
    )
    told = cast("SeenColours", Told([one], np.array([0]), poses_of(best)[None]))
    drawn = with_drawn_turns(np.random.default_rng(seed), told, WORLD_FROM_CAMERA, samples)
    after = matrices_of(cast("Any", drawn.poses)[:, :, 0])
    between = (np.linalg.inv(WORLD_FROM_CAMERA @ best) @ after)[..., :3, :3]
    way = np.einsum("scij,tij->sct", between, turns[:, :3, :3]).argmax(axis=-1)
    return way, after, samples, drawn


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
    gained = np.log(SHARES[way] / SHARES[start]).ravel()[1:]
    assert np.allclose(drawn.log_posterior.ravel()[1:], gained)


def test_faces_that_touch_touch_after_a_turn(seed: int) -> None:
    """That on which the box lies, and that on which another object rests, point where they did."""
    start = np.random.default_rng(seed).integers(4, size=(40, 2))
    _, after, samples, drawn = drawn_from(seed, box(), start)
    before = matrices_of(samples.poses[:, :, 0])
    normals = np.eye(3)[FACE_AXES] * FACE_SIGNS[:, None]
    for name, body in (("child_faces", 0), ("parent_faces", 1)):
        faces = [getattr(one, name)[..., body] for one in (samples, drawn)]
        pointed, points = (
            np.einsum("scij,scj->sci", poses[..., :3, :3], normals[each])
            for poses, each in zip((before, after), faces, strict=True)
        )
        np.testing.assert_allclose(points, pointed, atol=0.02)
        assert (faces[0] != faces[1]).any()
    np.testing.assert_array_equal(drawn.child_faces[..., 1:], samples.child_faces[..., 1:])
