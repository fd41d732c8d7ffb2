"""Poses as the BOP challenge reads them."""

from dataclasses import replace

import numpy as np

from pipeline.publishing.bop_poses import bop_lines
from pipeline.publishing.values import RunValues
from pipeline.surfaces import SceneSurface, Surfaces
from recordings.dataset_numbers import DatasetNumbers
from scene.result import SceneResult
from tests.scene.results import scene_result


def scene(names: list[str], presence: list[float]) -> SceneResult:
    """Objects at distinct places, turned a quarter about x."""
    poses = np.tile(np.eye(4), (len(names), 1, 1))
    poses[:, :3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    poses[:, 0, 3] = 0.1 * np.arange(len(names))
    on_table = [len(names)] * len(names)
    return replace(scene_result(names, poses, on_table), presence=np.array(presence), frames=np.array([7]))


def test_one_line_for_each_object_found() -> None:
    """Ids that are known, else the lowest that are left; millimetres; nothing for what is absent."""
    names = ["003_cracker_box", "obj_000012", "cup", "2nd"]
    box = SceneSurface(vertices_m=np.zeros((3, 3)), faces=np.zeros((1, 3), np.int64))
    surfaces = Surfaces(dict.fromkeys(names, box), DatasetNumbers(object_ids={"obj_000012": 12}))
    found = scene(names, [0.9, 0.8, 0.7, 0.1])
    values = RunValues(slam=None, room=None, shapes={}, surfaces=surfaces, scene=found)
    lines = bop_lines(values).splitlines()
    assert lines[0] == "scene_id,im_id,obj_id,score,R,t,time"
    fields = [line.split(",") for line in lines[1:]]
    assert [int(row[2]) for row in fields] == [1, 12, 3]
    assert {(row[0], row[1], row[6]) for row in fields} == {("0", "7", "-1")}
    assert [float(row[5].split()[0]) for row in fields] == [0, 100, 200]
    np.testing.assert_allclose(np.array(fields[0][4].split(), float), [1, 0, 0, 0, 0, -1, 0, 1, 0], atol=1e-9)
