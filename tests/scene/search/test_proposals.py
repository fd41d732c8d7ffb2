"""Poses from masks among those that the search refines: a box on a table, both sources, one alone."""

from pathlib import Path
from typing import Literal

import jax
import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from pipeline.synthesis.world import Part, RayCaster
from recordings.types import CameraIntrinsics, DepthNoise
from scene.config import ParseConfig
from scene.likelihood.object_renderer import ObjectRenderer
from scene.objects.scene_object import scene_object
from scene.observation.segmentation import scene_data
from scene.search.hypotheses import PosePools
from scene.search.search_round import FROM_MASKS, SearchRound
from scene.search.template_matching import CANDIDATES
from shapes import array_cache
from shapes.geometry.poses import matrices_of

INTRINSICS = CameraIntrinsics(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)
POOL = 8


@pytest.mark.parametrize("source", ["both", pytest.param("masks", marks=pytest.mark.slow)])
def test_hypotheses_from_masks_hold_the_truth(
    source: Literal["both", "masks"], seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before refinement within a cell of 8 mm and an orientation step, after it within 2 mm."""
    monkeypatch.setattr(array_cache, "user_cache_path", lambda *_, **__: tmp_path)
    mesh = trimesh.creation.box((0.12, 0.07, 0.05))
    slant = np.sqrt(0.5)
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = np.array([[1, 0, 0], [0, -slant, slant], [0, -slant, -slant]])
    world_from_camera[:3, 3] = [0, -0.5, 0.5]
    below, on = (trimesh.transformations.translation_matrix((0, 0, height)) for height in (-0.01, 0.025))
    parts = [
        Part(name="table", mesh=trimesh.creation.box((1.0, 1.0, 0.02)), world_from_part=below),
        Part(name="box", mesh=mesh, world_from_part=on),
    ]
    depth_m = RayCaster(parts).view(INTRINSICS, world_from_camera).depth_m.astype(np.float32)
    box = scene_object("box", mesh.vertices, mesh.faces)
    points_m = np.asarray(trimesh.sample.sample_surface(mesh, 4000, seed=0)[0])
    true_m = trimesh.transform_points(points_m, np.linalg.inv(world_from_camera) @ on)

    def error_m(pose: np.ndarray) -> float:
        return float(KDTree(trimesh.transform_points(points_m, pose)).query(true_m)[0].mean())

    with jax.enable_x64(False):  # as the program starts it
        data = scene_data(np.where(np.isfinite(depth_m), depth_m, 0), INTRINSICS, seed)
        config = ParseConfig(proposals=source, pool=POOL)
        rng = np.random.default_rng(seed)
        pools = PosePools.of(data, [box], ObjectRenderer.of([box]), DepthNoise(), config, config.pool)
        refined, candidates = SearchRound.of(pools, rng).hypotheses(pools, {0: data.foreground})
        kept = pools.densest(refined, np.array([pools.absent]), [0])

    assert kept.shape == (1, POOL, 7)
    assert candidates.shape == (1, CANDIDATES, 7)
    from_masks = matrices_of(candidates[0, CANDIDATES - FROM_MASKS[source] :])
    assert min(map(error_m, from_masks[:48])) < 0.008
    assert error_m(matrices_of(kept[0])[0]) < 0.002
