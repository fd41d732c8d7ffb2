"""What a parsed scene says of its own uncertainty."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from scene.result import SceneResult
from shapes.archive import load_arrays, save_arrays
from shapes.geometry.poses import poses_of
from tests.scene.results import scene_result


def test_the_spread_of_a_point_is_that_of_its_samples(seed: int) -> None:
    """Half of the samples are turned by half a turn: nothing is linearised."""
    generator = np.random.default_rng(seed)
    point = generator.normal(size=3)
    turns = Rotation.from_rotvec(np.pi * (np.arange(40) % 2)[:, None] * [0.0, 0.0, 1.0])
    samples = np.tile(np.eye(4), (40, 1, 1))
    samples[:, :3, :3] = (turns * Rotation.from_rotvec(generator.normal(0, 0.01, (40, 3)))).as_matrix()
    scene = replace(
        scene_result(["mug"], [np.eye(4)], [0]),
        sample_poses=poses_of(samples)[:, None],
        sample_modes=(np.arange(40, dtype=np.int32) % 2)[:, None],
    )
    aside = samples[:, :3, :3] @ point - point

    np.testing.assert_allclose(scene.covariance_of_point(0, point), aside.T @ aside / 40, atol=1e-12)
    in_mode = np.cov(aside[1::2].T, bias=True)
    np.testing.assert_allclose(scene.covariance_of_point(0, point, mode=1), in_mode, atol=1e-12)


def test_the_spread_of_the_origin_is_a_distance_where_samples_spin() -> None:
    """About a line 5 cm beside the origin: that is 5 cm times sqrt 2 from one of its places on average."""
    angles = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    samples, aside = np.tile(np.eye(4), (90, 1, 1)), np.eye(4)
    samples[:, :3, :3] = Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    aside[0, 3] = 0.05
    scene = scene_result(["can"], [aside], [0])
    spun = replace(scene, sample_poses=poses_of(samples @ aside)[:, None])

    np.testing.assert_allclose(spun.position_std_m, 0.05 * np.sqrt(2))


def test_a_file_of_the_format_before_tells_all_presence_as_out_of_sight(tmp_path: Path) -> None:
    """It did not say which part of a presence is in sight."""
    scene = scene_result(["mug", "can"], np.tile(np.eye(4), (2, 1, 1)), [2, 2])
    scene = replace(scene, presence=np.array([0.3, 0.2]), hidden_presence=np.array([0.1, 0.2]))
    scene.save(tmp_path / "now.npz")
    arrays = load_arrays(tmp_path / "now.npz")
    del arrays["hidden_presence"]
    save_arrays(tmp_path / "before.npz", {**arrays, "format_version": np.array(7)})

    now, before = (SceneResult.load(tmp_path / name) for name in ("now.npz", "before.npz"))

    np.testing.assert_allclose(now.presence_out_of_sight, [0.1, 0.2])
    np.testing.assert_allclose(before.presence_out_of_sight, [0.3, 0.2])
