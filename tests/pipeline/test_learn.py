"""`voxscene learn` and the export of its run, on a small film of a can on a pedestal."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

from pipeline.cli import voxscene
from pipeline.evaluation.shapes import shape_agreement
from pipeline.evaluation.truth import RecordedTruth, true_mesh
from pipeline.synthesis.filming import film_object
from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.paths import PathConfig
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import CameraConfig, ObjectScene
from pipeline.synthesis.writing import write_recording
from shapes.prior import ShapePrior


@pytest.fixture(scope="module")
def can_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight views of a can from two heights."""
    scene = ObjectScene(
        camera=CameraConfig(width=240, height=180),
        room=RoomConfig(kind="bare"),
        path=PathConfig(kind="rings", frames=8, radius_m=0.6, elevations_deg=(25.0, 55.0)),
    )
    path = tmp_path_factory.mktemp("recordings") / "can.mcap"
    write_recording(film_object("can", built_in_object("can"), scene, 7), path)
    return path


@pytest.fixture(scope="module")
def can_run(can_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """The run folder of learning it with the recorded poses, and what --json printed."""
    run = tmp_path_factory.mktemp("runs") / "can.run"
    options = ["--name", "can", "--poses", "recorded", "-o", str(run), "--json"]
    result = CliRunner().invoke(voxscene, ["learn", str(can_file), *options])
    assert result.exit_code == 0, result.output
    return run, json.loads(result.stdout)


def test_the_shape_agrees_with_the_truth(can_file: Path, can_run: tuple[Path, dict]) -> None:
    """Solid and observed voxels, on the support plane's own axes."""
    run, document = can_run
    shape = ShapePrior.load(run / "shapes" / "can.npz")
    truth = RecordedTruth(can_file)
    reference_from_world = truth.camera_from_world(int(truth.trajectory.times_ns[0]))
    one = truth.object_of_shape("can")
    agreement = shape_agreement(shape, true_mesh(one), reference_from_world @ one.world_from_object)
    assert agreement.solid > 0.9
    assert agreement.observed > 0.85
    up = reference_from_world[:3, 2]
    assert shape.reference_from_grid[:3, 2] @ up > np.cos(np.radians(0.5))
    height = np.linalg.inv(reference_from_world) @ shape.reference_from_grid
    assert abs(height[2, 3] - 0.9) < 0.001  # the pedestal's top, under layer k = 0
    assert document["seen_occupied"] == shape.seen_occupied.sum()
    assert document["seconds"] > 0


def test_the_shape_is_judged_along_the_recorded_path(can_file: Path, can_run: tuple[Path, dict]) -> None:
    """With which it was learned: slam never ran."""
    run, _ = can_run
    result = CliRunner().invoke(voxscene, ["eval", "shapes", str(run), "--truth", str(can_file), "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["can"]["solid"] > 0.9


def test_the_extent_is_that_of_what_was_seen_and_two_voxels(can_run: tuple[Path, dict]) -> None:
    """On every side but below, where the grid starts on the plane."""
    shape = ShapePrior.load(can_run[0] / "shapes" / "can.npz")
    occupied = np.argwhere(shape.seen_occupied)
    assert (occupied.min(axis=0)[:2] == 2).all()
    assert (np.asarray(shape.phi.shape) - occupied.max(axis=0) == 3).all()
    assert shape.seen_occupied[:, :, 0].any()


def test_a_box_says_where(can_file: Path, can_run: tuple[Path, dict], tmp_path: Path) -> None:
    """The object in --box is that found without; a box beside it holds nothing."""
    shape = ShapePrior.load(can_run[0] / "shapes" / "can.npz")
    corners = trimesh.bounds.corners(shape.bounding_box_m)
    corners = trimesh.transform_points(corners, shape.reference_from_grid)
    box = [*(corners.min(axis=0) - 0.02), *(corners.max(axis=0) + 0.02)]
    options = ["--name", "can", "--poses", "recorded", "-o", str(tmp_path / "run"), "--json"]

    def learn(values: list[float]) -> tuple[int, str]:
        text = ",".join(f"{value:.3f}" for value in values)
        result = CliRunner().invoke(voxscene, ["learn", str(can_file), "--box", text, *options])
        return result.exit_code, result.output

    code, output = learn(box)
    assert code == 0, output
    boxed = ShapePrior.load(tmp_path / "run" / "shapes" / "can.npz")
    np.testing.assert_allclose(
        np.ptp(boxed.bounding_box_m, axis=0), np.ptp(shape.bounding_box_m, axis=0), atol=0.0051
    )
    code, output = learn([5.0, 5, 5, 5.1, 5.1, 5.1])
    assert code == 1
    assert "nothing was measured in the region" in output


def test_a_run_exports_its_objects_where_they_stand(can_run: tuple[Path, dict], tmp_path: Path) -> None:
    """In the reference frame, as single meshes; and as one scene whose y axis is the support's normal."""
    run = can_run[0]
    result = CliRunner().invoke(voxscene, ["export", str(run), "--format", "ply,glb", "-o", str(tmp_path)])
    assert result.exit_code == 0, result.output
    shape = ShapePrior.load(run / "shapes" / "can.npz")
    middle = shape.bounding_box_m.mean(axis=0)
    expected = (shape.reference_from_grid @ [*middle, 1.0])[:3]
    mesh = trimesh.load_mesh(tmp_path / "can.ply")
    assert np.linalg.norm(mesh.center_mass - expected) < 0.005
    scene = trimesh.load(tmp_path / "scene.glb")
    heights = np.asarray(mesh.vertices) @ shape.reference_from_grid[:3, 2]
    np.testing.assert_allclose(scene.bounds[:, 1], [heights.min(), heights.max()], atol=1e-5)
