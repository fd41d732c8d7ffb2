"""Data sets on disk as sources, and results files of other programs."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.benchmarks.bop_results import check_results, write_results
from pipeline.benchmarks.pose_methods import Results
from pipeline.benchmarks.pose_sources import BopImages
from pipeline.benchmarks.poses import judgements
from pipeline.errors import PipelineError
from pipeline.mesh_source import MeshSource

SHAPES = MeshSource(names=("box", "can"))
POSES = {"box": (0.0, 0.0, 0.8), "can": (0.15, 0.0, 0.9)}
RESULT = "{scene},{image},{object},1.0,1 0 0 0 1 0 0 0 1,{x} {y} {z},-1"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A data set of one scene and one image, with both objects and only the box a target."""
    scene = tmp_path / "set" / "test" / "000007"
    (scene / "depth").mkdir(parents=True)
    Image.fromarray(np.full((60, 80), 9000, np.uint16)).save(scene / "depth" / "000003.png")
    camera = {"cam_K": [80, 0, 39.5, 0, 80, 29.5, 0, 0, 1], "depth_scale": 0.1}
    truths = [
        {
            "obj_id": SHAPES.ids[name],
            "cam_R_m2c": np.eye(3).ravel().tolist(),
            "cam_t_m2c": [1000 * value for value in place],
        }
        for name, place in POSES.items()
    ]
    (scene / "scene_camera.json").write_text(json.dumps({"3": camera}))
    (scene / "scene_gt.json").write_text(json.dumps({"3": truths}))
    target = {"scene_id": 7, "im_id": 3, "obj_id": SHAPES.ids["box"], "inst_count": 1}
    (tmp_path / "set" / "test_targets_bop19.json").write_text(json.dumps([target]))
    models = tmp_path / "set" / "models"
    models.mkdir()
    for name, mesh in SHAPES.meshes.items():
        copy = mesh.copy()
        copy.apply_scale(1000)
        copy.export(models / f"obj_{SHAPES.ids[name]:06d}.ply")
    return tmp_path / "set"


def source(root: Path) -> BopImages:
    """The data set with its own models."""
    return BopImages(root=root, split="test", shapes=MeshSource.of(root / "models", "mm"))


def test_targets_of_a_data_set_are_judged(root: Path) -> None:
    """The box alone, at its place; with no targets file, all that is annotated."""
    (key,) = source(root).places()
    assert (key.scene_id, key.im_id) == (7, 3)
    image = source(root).image(key)
    (one,) = image.objects
    assert one.shape == f"obj_{SHAPES.ids['box']:06d}"
    np.testing.assert_allclose(one.world_from_object[:3, 3], POSES["box"])
    assert image.frame.depth_m[0, 0] == np.float32(0.9)


def test_another_programs_results_are_a_column(root: Path, tmp_path: Path) -> None:
    """The best score of each object counts; lines of other images do not."""
    path = tmp_path / "other.csv"
    about = {"scene": 7, "image": 3, "object": SHAPES.ids["box"], "x": 0, "y": 0}
    lines = [
        "scene_id,im_id,obj_id,score,R,t,time",
        RESULT.format(**about, z=800),
        RESULT.format(**about, z=900).replace(",1.0,", ",0.2,"),
    ]
    path.write_text("\n".join(lines) + "\n")
    bop = source(root)
    (key,) = bop.places()
    check_results(path, bop.shapes.ids.values(), [(7, 3)])
    image, method = bop.image(key), Results(title="other", path=path)
    (row,) = judgements(image, method, method.estimate(image, bop.shapes))
    assert row.error_m == pytest.approx(0, abs=1e-9)


def test_what_was_found_scores_the_same_as_a_results_file(root: Path, tmp_path: Path) -> None:
    """Written, looked through, and judged again: the ids of the data set, errors to a micrometre."""
    path, again = tmp_path / "first.csv", tmp_path / "again.csv"
    about = {"scene": 7, "image": 3, "object": SHAPES.ids["box"], "x": 4, "y": -2}
    path.write_text(RESULT.format(**about, z=803) + "\n")
    bop = source(root)
    (key,) = bop.places()
    image, method = bop.image(key), Results(title="first", path=path)
    rows = judgements(image, method, method.estimate(image, bop.shapes))

    write_results(again, rows, bop.shapes.ids, {key: 1.5})

    check_results(again, bop.shapes.ids.values(), [(7, 3)])
    second = Results(title="again", path=again)
    (row,) = judgements(image, second, second.estimate(image, bop.shapes))
    assert row.error_m == pytest.approx(rows[0].error_m, abs=1e-6)
    assert row.error_m > 0.002
    assert again.read_text().splitlines()[1].endswith(",1.5")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (RESULT.format(scene=7, image=3, object=99, x=0, y=0, z=800), "no object 99"),
        (RESULT.format(scene=7, image=3, object=1, x=0, y=0, z=0.8), "look like metres"),
        (RESULT.format(scene=8, image=3, object=1, x=0, y=0, z=800), "says nothing of the images"),
        ("7,3,1,1.0,1 0 0,0 0 800,-1", "line 1"),
    ],
)
def test_results_that_cannot_be_used_are_told(tmp_path: Path, line: str, message: str) -> None:
    """One sentence that names the file."""
    path = tmp_path / "other.csv"
    path.write_text(line + "\n")
    with pytest.raises(PipelineError, match=message) as error:
        check_results(path, [1, 2], [(7, 3)])
    assert "other.csv" in str(error.value)


def test_folders_that_are_no_data_set_are_told(root: Path, tmp_path: Path) -> None:
    """Nothing there, several cameras, a target without its image."""
    with pytest.raises(PipelineError, match="is it a BOP data set"):
        BopImages(root=tmp_path, split="test", shapes=SHAPES).places()
    targets = root / "test_targets_bop19.json"
    targets.write_text(json.dumps([{"scene_id": 7, "im_id": 9, "obj_id": 1, "inst_count": 1}]))
    with pytest.raises(PipelineError, match="no annotated image 9 of scene 7"):
        source(root).places()
