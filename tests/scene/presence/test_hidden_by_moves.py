"""A mug that a box may hide (supplement L, Fig. 7): moves in and out against the exact answer."""

import jax
import numpy as np
import pytest

from pipeline.benchmarks.occlusion import BOX, MUG, PRIOR, evidence_against, mug_posterior, photographed
from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.occlusion import FAR_M, PRESENCE, SCENES, box_pose
from scene.model.number_prior import BinomialNumber
from scene.objects.scene_object import scene_object
from scene.presence.forests import ForestPrior
from scene.presence.posterior import Ensemble, chain_presence
from scene.presence.toggling import Candidates, SlotLayers

COUNT, DRAWINGS, CHAINS = 64, 12, 16


@pytest.mark.parametrize(
    "name", ["turned", *[pytest.param(one, marks=pytest.mark.slow) for one in ("wide", "closer")]]
)
def test_moves_tell_what_the_sum_tells(name: str, seed: int) -> None:
    """Candidates from the prior, the box at its true pose: within five standard errors, 0.02 each at most."""
    with jax.enable_x64(False):
        rng = np.random.default_rng(seed)
        meshes = {one: built_in_object(one) for one in (BOX, MUG)}
        objects = {one: scene_object(one, mesh.vertices, mesh.faces) for one, mesh in meshes.items()}
        yaw_deg, away_m = SCENES[name]
        scene = photographed(name, meshes, {BOX: box_pose(yaw_deg, 0.0, away_m)}, 48, [seed])
        empty = evidence_against(scene, np.full((1, *scene.depth_m.shape), FAR_M, np.float32))
        box = empty.layers(objects[BOX], scene.camera_from_object[BOX][None])
        behind = evidence_against(scene, np.minimum(box, FAR_M))
        number = BinomialNumber(PRESENCE)
        exact = mug_posterior(rng, objects[MUG], behind, 2**16)

        def draw(before: Ensemble | None) -> Ensemble:
            drawn = PRIOR.draw(rng, [objects[MUG]], COUNT)
            if before is not None and before.in_use[0]:
                drawn[0, 0] = before.chosen[0]
            gain = behind.log_ratios(objects[MUG], drawn[0]).astype(np.float32)[:, None]
            layers = SlotLayers(np.zeros(1, np.intp), np.ones_like(gain), gain)
            alone, beside = np.ones((1, COUNT)), np.zeros((2, 1, COUNT))
            prior = ForestPrior(alone, lambda *_: beside, np.zeros(2), number.log_set_probabilities(1), 1)
            candidates = Candidates([layers], np.zeros((1, COUNT)), prior, np.full(1, -np.inf))
            return Ensemble.of(drawn, np.zeros(drawn.shape[:2], int), candidates, before)

        told = [chain_presence(rng, draw, None, DRAWINGS, 2)[0][0, 0] for _ in range(CHAINS)]

    error = np.hypot(np.std(told, ddof=1) / np.sqrt(CHAINS), exact.standard_error[0])
    print(f"{name}: moves {np.mean(told):.3f}, exact {exact.presence[0]:.3f}, error {error:.3f}")
    assert error < 0.02
    assert abs(np.mean(told) - exact.presence[0]) < 5 * error
