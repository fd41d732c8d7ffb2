"""Poses as the BOP challenge reads them."""

import numpy as np

from pipeline.publishing.bop_poses import bop_lines
from scene.result import SceneResult


def scene(names: list[str], presence: list[float]) -> SceneResult:
    """Objects at distinct places, turned a quarter about x."""
    count = len(names)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    poses[:, 0, 3] = 0.1 * np.arange(count)
    return SceneResult(
        names=np.array(names),
        frames=np.array([7]),
        camera_from_object=poses,
        mean=poses,
        covariance=np.tile(np.eye(6), (count, 1, 1)),
        presence=np.array(presence),
        visible_fraction=np.ones(count),
        mode_poses=poses[:, None],
        mode_probabilities=np.ones((count, 1)),
        edge_probabilities=np.zeros((count, count + 1)),
        edge_faces=np.full((count, count + 1, 2), -1, np.int32),
        sample_poses=np.zeros((1, count, 7)),
        sample_parents=np.full((1, count), -1, np.int32),
        sample_log_posteriors=np.zeros(1),
        chain=np.zeros(1, np.int32),
    )


def test_one_line_for_each_object_found() -> None:
    """Ids from names that hold one, else places; millimetres; nothing for what is absent."""
    names = ["003_cracker_box", "obj_000012", "cup", "2nd"]
    lines = bop_lines(scene(names, [0.9, 0.8, 0.7, 0.1])).splitlines()
    assert lines[0] == "scene_id,im_id,obj_id,score,R,t,time"
    fields = [line.split(",") for line in lines[1:]]
    assert [int(row[2]) for row in fields] == [3, 12, 3]
    assert {(row[0], row[1], row[6]) for row in fields} == {("0", "7", "-1")}
    assert [float(row[5].split()[0]) for row in fields] == [0, 100, 200]
    np.testing.assert_allclose(np.array(fields[0][4].split(), float), [1, 0, 0, 0, 0, -1, 0, 1, 0], atol=1e-9)
