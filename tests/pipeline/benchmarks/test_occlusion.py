"""The bench of hidden objects on few draws."""

from pathlib import Path

import numpy as np

from pipeline.benchmarks.occlusion import figures, measure_occlusion, write_rows
from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.occlusion import (
    FAR_M,
    box_pose,
    hidden_fraction,
    occlusion_camera,
    occlusion_scene,
    write_occlusion_scene,
)
from recordings.reading import open_recording
from recordings.truth import recorded_scene_truth


def test_the_order_of_the_supplements_figure(tmp_path: Path) -> None:
    """Turned < wide < closer, and the box there for certain: they differ by many standard errors."""
    rows = measure_occlusion(0, 0, 48, 4096, lambda *_: None)
    write_rows(tmp_path / "rows.csv", rows)

    told = figures(rows)
    assert told["in_order"]
    assert told["least_box"] > 0.99
    assert len((tmp_path / "rows.csv").read_text().splitlines()) == 4


def test_an_empty_volume_hides_nothing_and_a_wall_hides_what_is_behind() -> None:
    """Against the cuboid's own share."""
    empty = occlusion_scene("empty", {}, {}, occlusion_camera(64), [0])
    assert hidden_fraction(empty) == 0

    empty.ideal_m[:] = 0.9
    assert abs(hidden_fraction(empty) - 0.5) < 0.01


def test_recordings_hold_the_image_and_the_truth(tmp_path: Path) -> None:
    """Depth as it was drawn, the box at its pose."""
    meshes = {"box": built_in_object("box")}
    pose = box_pose(30.0, 0.05, 0.8)
    scene = occlusion_scene("one", meshes, {"box": pose}, occlusion_camera(64), [0])
    path = tmp_path / "one.mcap"
    write_occlusion_scene(scene, meshes, path)

    (frame,) = list(open_recording(path))
    np.testing.assert_allclose(frame.depth_m, np.maximum(scene.depth_m, 1e-3), atol=1e-6)
    assert abs(np.median(frame.depth_m[:5]) - FAR_M) < 0.005
    told = recorded_scene_truth(path)
    assert told is not None
    (truth,) = told.objects
    np.testing.assert_allclose(truth.world_from_object, pose, atol=1e-9)
