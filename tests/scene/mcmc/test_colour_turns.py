"""Turns are drawn as their colours say, wherever the chains left them."""

from dataclasses import dataclass
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


def test_turns_are_drawn_from_their_conditional(seed: int) -> None:
    """From samples in all four ways: the ways afterwards are as told (chi-squared, false alarm 1e-4).

    Places are kept to a micrometre: a turn about the middle moves nothing. A sample that lies elsewhere keeps
    its turn.
    """
    rng = np.random.default_rng(seed)
    one = box()
    turns = turns_of(one)
    best = matrices_of(np.array([0.8, 0.6, 0, 0, 0.05, 0.02, 0.6]))
    start = rng.integers(4, size=(500, 2))
    poses = (WORLD_FROM_CAMERA @ best)[None, None] @ turns[start]
    poses[0, 0, :3, 3] += 0.1
    samples = Samples(
        poses=poses_of(poses)[..., None, :],
        parents=np.zeros((500, 2, 1), np.int32),
        parent_faces=np.zeros((500, 2, 1), np.int32),
        child_faces=np.zeros((500, 2, 1), np.int32),
        log_posterior=np.zeros((500, 2)),
        accepted=np.ones((500, 2)),
    )
    told = cast("SeenColours", Told([one], np.array([0]), poses_of(best)[None]))
    drawn = with_drawn_turns(rng, told, WORLD_FROM_CAMERA, samples)
    after = matrices_of(cast("Any", drawn.poses)[:, :, 0])
    assert np.array_equal(drawn.poses[0, 0], samples.poses[0, 0])
    assert np.abs(after - poses)[..., :3, 3].max() < 2e-3
    way = np.einsum(
        "scij,tij->sct", (np.linalg.inv(WORLD_FROM_CAMERA @ best) @ after)[..., :3, :3], turns[:, :3, :3]
    )
    counts = np.bincount(way.argmax(axis=-1).ravel()[1:], minlength=4)
    assert chisquare(counts, SHARES * counts.sum()).pvalue > 1e-4
    assert np.allclose(np.exp(drawn.log_posterior.ravel()[1:]), SHARES[way.argmax(axis=-1).ravel()[1:]])
