"""Real data sets, imported: pixels, cameras, stamps and truth are those of their files."""

import json

import numpy as np
import pytest
from PIL import Image

from recordings.poses.recorded import recorded_trajectory
from recordings.poses.rigid import orthonormalised
from recordings.reading import open_recording
from recordings.truth import recorded_scene_truth
from tests.recordings.test_importers import run


def test_the_real_kitchen(shared_data, recording_path):
    """7-Scenes' redkitchen: pixels, stamps and poses of the files."""
    folder = shared_data / "sevenscenes_redkitchen"
    run("7scenes", folder, recording_path, frames=slice(10))
    trajectory = recorded_trajectory(recording_path)
    for i, frame in enumerate(open_recording(recording_path)):
        stored = np.asarray(Image.open(folder / f"frame-{i:06d}.depth.png"))
        np.testing.assert_array_equal(frame.depth_m, (stored / 1000).astype(np.float32))
        assert trajectory is not None
        pose = orthonormalised(np.loadtxt(folder / f"frame-{i:06d}.pose.txt"))
        np.testing.assert_allclose(trajectory.reference_from_camera[i], pose, atol=1e-9)


@pytest.mark.parametrize("scene", ["0001", "0002"])
def test_real_ycb_video(scene, shared_data, recording_path):
    """YCB-Video: in every frame the truth puts the objects where that frame's own annotation does."""
    folder = shared_data / "ycbv" / "scenes" / scene
    run("bop", folder, recording_path)
    truth, trajectory = recorded_scene_truth(recording_path), recorded_trajectory(recording_path)
    annotations = json.loads((folder / "gt.json").read_text())
    assert truth is not None
    assert trajectory is not None
    assert len(trajectory) == len(annotations) == len(open_recording(recording_path))
    for pose, annotation in zip(trajectory.reference_from_camera, annotations, strict=True):
        for true_object, expected in zip(truth.objects, annotation["objects"], strict=True):
            assert true_object.name == expected["name"]
            found = np.linalg.inv(pose) @ true_object.world_from_object
            # the annotators' world is constant to 0.2 mm (PROVENANCE)
            np.testing.assert_allclose(found[:3, 3], np.array(expected["T_cam_obj"])[:3, 3], atol=1e-3)
    frame = next(iter(open_recording(recording_path)))
    stored = np.asarray(Image.open(folder / "000001-depth.png"))
    np.testing.assert_allclose(frame.depth_m, stored / 10000, rtol=1e-6)
    assert frame.rgb is not None


def test_real_frames_of_unrelated_scenes(shared_data, recording_path):
    """YCB-Video's synthetic frames: the first one's objects are the truth, no other camera is known."""
    folder = shared_data / "ycbv" / "syn"
    (remark,) = run("bop", folder, recording_path)
    assert "10 frames have no camera truth" in remark
    truth = recorded_scene_truth(recording_path)
    assert truth is not None
    expected = json.loads((folder / "gt.json").read_text())[0]["objects"]
    assert [one.name for one in truth.objects] == [one["name"] for one in expected]
    for one, other in zip(truth.objects, expected, strict=True):
        np.testing.assert_allclose(one.world_from_object, other["T_cam_obj"], atol=1e-4)
    assert len(open_recording(recording_path)) == 11


def test_real_redwood(shared_data, recording_path):
    """Redwood's living room: pixels, colour and trajectory.log."""
    folder = shared_data / "redwood5"
    run("redwood", folder, recording_path)
    trajectory = recorded_trajectory(recording_path)
    log = np.array((folder / "trajectory.log").read_text().split(), float).reshape(-1, 19)
    assert trajectory is not None
    np.testing.assert_allclose(
        trajectory.reference_from_camera[:, :3, 3], log[:, 3:].reshape(-1, 4, 4)[:, :3, 3], atol=1e-9
    )
    images = sorted((folder / "depth").iterdir())
    for frame, file in zip(open_recording(recording_path), images, strict=True):
        np.testing.assert_array_equal(frame.depth_m, (np.asarray(Image.open(file)) / 1000).astype("f4"))
        assert frame.rgb is not None


def test_a_real_scan_with_gaps_in_its_numbers(shared_data, recording_path):
    """Every other frame of a hand-held scan: numbers are time, intrinsics.K.txt the camera."""
    run("7scenes", shared_data / "apc_shelf_handheld", recording_path)
    recording = open_recording(recording_path)
    assert recording.intrinsics.fx == pytest.approx(615.195, abs=1e-3)
    stamps = [frame.time_ns for frame in recording]
    assert stamps == [round(number * 1e9 / 30) for number in range(15, 114, 2)]
    trajectory = recorded_trajectory(recording_path)
    assert trajectory is not None
    np.testing.assert_array_equal(trajectory.times_ns, stamps)
    np.testing.assert_allclose(trajectory.reference_from_camera[0], np.eye(4), atol=1e-6)
