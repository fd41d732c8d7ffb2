"""Imported recordings hold the pixels, times, cameras and truth of their sources."""

import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer

from recordings.errors import RecordingError
from recordings.importers.dataset import ALL_FRAMES
from recordings.importers.formats import import_recording
from recordings.options import ReadOptions
from recordings.poses.recorded import recorded_trajectory
from recordings.reading import open_recording
from recordings.truth import recorded_scene_truth
from tests.recordings.samples import (
    ROS1_STORE,
    SECOND_NS,
    STORE,
    camera_info,
    compressed_image,
    image,
    ros1_bytes,
    transform,
)

THIRTIETH_NS = [round(i * SECOND_NS / 30) for i in range(2000)]


def run(format_, source, out, *, frames=ALL_FRAMES, intrinsics=None) -> tuple[str, ...]:
    """Import without a progress display."""
    return import_recording(
        format_, source, out, frames=frames, intrinsics=intrinsics, progress=lambda *_: None
    )


def png(path: Path, pixels: np.ndarray) -> None:
    """A PNG of 16-bit grey values."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels.astype(np.uint16)).save(path)


def jpg(path: Path, grey: int, size=(8, 6)) -> None:
    """A JPEG of one colour."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (grey, grey, grey)).save(path)


def depths(count: int) -> np.ndarray:
    """Small images (count, 6, 8) with a hole."""
    images = np.arange(count * 48).reshape(count, 6, 8) + 1000
    images[:, 0, 0] = 0
    return images


def moved(x: float) -> np.ndarray:
    """A pose moved along x and turned about y."""
    pose = np.eye(4)
    pose[0, 3] = x
    pose[0, 0] = pose[2, 2] = np.cos(x)
    pose[0, 2], pose[2, 0] = np.sin(x), -np.sin(x)
    return pose


def camera_of(path: Path) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a recording."""
    camera = open_recording(path).intrinsics
    return camera.fx, camera.fy, camera.cx, camera.cy


@pytest.mark.parametrize("camera", [None, "camera-intrinsics.txt", "intrinsics.K.txt"])
def test_7scenes(camera, tmp_path, recording_path):
    """Numbers are times, also across gaps; 65535 is no return; poses are made rigid; lost ones left out."""
    images = depths(4)
    images[1, 2, 2] = 65535
    for number, pixels in zip((3, 4, 7, 8), images, strict=True):
        png(tmp_path / f"frame-{number:06d}.depth.png", pixels)
        jpg(tmp_path / f"frame-{number:06d}.color.jpg", 9)
        pose = moved(number / 10).round(4) if number != 4 else np.full((4, 4), np.nan)
        np.savetxt(tmp_path / f"frame-{number:06d}.pose.txt", pose)
    if camera:
        np.savetxt(tmp_path / camera, [[500, 0, 3.5], [0, 501, 2.5], [0, 0, 1]])
    remarks = run("7scenes", tmp_path, recording_path)
    recording, trajectory = open_recording(recording_path), recorded_trajectory(recording_path)

    assert camera_of(recording_path) == ((500, 501, 3.5, 2.5) if camera else (585, 585, 320, 240))
    assert bool(remarks) == (camera is None)
    images[1, 2, 2] = 0
    for frame, number, pixels in zip(recording, (3, 4, 7, 8), images, strict=True):
        assert frame.time_ns == THIRTIETH_NS[number]
        assert frame.rgb is None
        np.testing.assert_array_equal(frame.depth_m, (pixels / 1000).astype(np.float32))
    assert trajectory is not None
    for time_ns, pose in zip(trajectory.times_ns, trajectory.reference_from_camera, strict=True):
        number = THIRTIETH_NS.index(time_ns)
        np.testing.assert_allclose(pose, moved(number / 10), atol=1e-3)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])  # the latter of editors on Windows
def test_tum(encoding, tmp_path, recording_path):
    """Stamps keep their digits, depth is in 1/5000 m, colour is the nearest within 20 ms."""
    folder = tmp_path / "rgbd_dataset_freiburg2_desk"
    images = depths(3)
    lines = ["# depth maps", "# timestamp filename"]
    for i, pixels in enumerate(images):
        png(folder / f"depth/{i}.png", pixels * 5)
        lines.append(f"1311868164.{363181 + i * 100000:06d}  depth/{i}.png")
    (folder / "depth.txt").write_text("\r\n".join(lines), encoding=encoding)
    jpg(folder / "rgb/0.jpg", 70)
    (folder / "rgb.txt").write_text("1311868164.370000 rgb/0.jpg\n", encoding=encoding)
    truth = [f"1311868164.{300000 + i * 50000:06d} {i} 0 0 0 0 0 1" for i in range(8)]
    (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(truth))
    assert run("tum", folder, recording_path) == ()
    frames, trajectory = list(open_recording(recording_path)), recorded_trajectory(recording_path)

    assert camera_of(recording_path) == (520.9, 521.0, 325.1, 249.7)
    assert [frame.time_ns for frame in frames] == [1311868164363181000 + i * 10**8 for i in range(3)]
    assert [frame.rgb is not None for frame in frames] == [True, False, False]
    for frame, pixels in zip(frames, images, strict=True):
        np.testing.assert_allclose(frame.depth_m, pixels / 1000, rtol=1e-6)
    assert trajectory is not None
    x = [(0.063181 + 0.1 * i) / 0.05 for i in range(3)]
    np.testing.assert_allclose(trajectory.reference_from_camera[:, 0, 3], x, rtol=1e-6)


def test_redwood(tmp_path, recording_path):
    """Millimetres, colour by order, trajectory.log, and an Open3D camera file by columns."""
    images = depths(3)
    log = ""
    for i, pixels in enumerate(images):
        png(tmp_path / f"depth/{i:05d}.png", pixels)
        jpg(tmp_path / f"color/{i:05d}.jpg", 50 + i)
        rows = "\n".join(" ".join(map(repr, row)) for row in moved(i / 5).tolist())
        log += f"{i} {i} {i + 1}\n{rows}\n"
    (tmp_path / "trajectory.log").write_text(log)
    matrix = [500.0, 0, 0, 0, 501.0, 0, 3.5, 2.5, 1]
    (tmp_path / "camera.json").write_text(json.dumps({"intrinsic_matrix": matrix}))
    run("redwood", tmp_path, recording_path)
    frames, trajectory = list(open_recording(recording_path)), recorded_trajectory(recording_path)

    assert camera_of(recording_path) == (500, 501, 3.5, 2.5)
    assert [round(float(np.mean(f.rgb))) for f in frames if f.rgb is not None] == [50, 51, 52]
    for i, (frame, pixels) in enumerate(zip(frames, images, strict=True)):
        assert frame.time_ns == THIRTIETH_NS[i]
        np.testing.assert_array_equal(frame.depth_m, (pixels / 1000).astype(np.float32))
    assert trajectory is not None
    np.testing.assert_allclose(trajectory.reference_from_camera, [moved(i / 5) for i in range(3)], atol=1e-12)


def test_redwood_images_are_in_the_order_of_their_numbers(tmp_path, recording_path):
    """Also where the names have no leading zeros, as 10.png after 9.png; colour with them."""
    for i, pixels in enumerate(depths(12)):
        png(tmp_path / f"depth/{i}.png", pixels)
        jpg(tmp_path / f"color/frame-{i}.jpg", 50 + i)
    run("redwood", tmp_path, recording_path)
    frames = list(open_recording(recording_path))
    assert [round(float(np.mean(f.rgb))) for f in frames if f.rgb is not None] == list(range(50, 62))
    for frame, pixels in zip(frames, depths(12), strict=True):
        np.testing.assert_array_equal(frame.depth_m, (pixels / 1000).astype(np.float32))


def test_redwood_poses_before_the_first_frame_are_left_out(tmp_path, recording_path):
    """Stamps of ROS begin at zero, which is the first frame's."""
    png(tmp_path / "depth/0.png", depths(1)[0])
    pose = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    (tmp_path / "trajectory.log").write_text("".join(f"{i} {i} 0\n{pose}" for i in (-1, 0)))
    run("redwood", tmp_path, recording_path)
    trajectory = recorded_trajectory(recording_path)
    assert trajectory is not None
    assert trajectory.times_ns.tolist() == [0]


def write_bop(folder: Path, *, with_world: bool, still: bool = True) -> tuple[list, np.ndarray]:
    """A BOP scene of two objects and three frames; world_from_camera and world_from_object."""
    cameras, objects, infos = {}, {}, {}
    poses = [moved(i / 4) for i in range(3)]
    things = np.stack([moved(0.3), moved(-0.4)])
    things[:, 2, 3] = 1.0
    for i, pose in enumerate(poses):
        png(folder / f"depth/{i * 5:06d}.png", depths(3)[i] * 10)
        jpg(folder / f"rgb/{i * 5:06d}.jpg", 80)
        key = str(i * 5)
        cameras[key] = {"cam_K": [500, 0, 3.5, 0, 501, 2.5, 0, 0, 1], "depth_scale": 0.1}
        world_to_camera = np.linalg.inv(pose)
        if with_world:
            cameras[key]["cam_R_w2c"] = world_to_camera[:3, :3].ravel().tolist()
            cameras[key]["cam_t_w2c"] = (world_to_camera[:3, 3] * 1000).tolist()
        objects[key] = []
        for number, thing in zip((7, 12), things, strict=True):
            shift = moved(0) if still or number == 7 else moved(i / 10)
            matrix = world_to_camera @ shift @ thing
            objects[key].append(
                {
                    "cam_R_m2c": matrix[:3, :3].ravel().tolist(),
                    "cam_t_m2c": (matrix[:3, 3] * 1000).tolist(),
                    "obj_id": number,
                }
            )
        infos[key] = [{"visib_fract": 0.75}, {"visib_fract": 1.0}]
    for name, content in {"camera": cameras, "gt": objects, "gt_info": infos}.items():
        (folder / f"scene_{name}.json").write_text(json.dumps(content))
    return poses, things


@pytest.mark.parametrize("with_world", [True, False])
def test_bop(with_world, tmp_path, recording_path):
    """Millimetres, depth scale and poses become metres; without a world the objects place the cameras."""
    poses, things = write_bop(tmp_path, with_world=with_world)
    assert run("bop", tmp_path, recording_path) == ()
    frames, trajectory = list(open_recording(recording_path)), recorded_trajectory(recording_path)
    truth = recorded_scene_truth(recording_path)

    origin = np.eye(4) if with_world else np.linalg.inv(poses[0])
    assert camera_of(recording_path) == (500, 501, 3.5, 2.5)
    assert [frame.time_ns for frame in frames] == [THIRTIETH_NS[i] for i in (0, 5, 10)]
    assert all(frame.rgb is not None for frame in frames)
    for frame, pixels in zip(frames, depths(3), strict=True):
        np.testing.assert_allclose(frame.depth_m, pixels / 1000, rtol=1e-6)
    assert trajectory is not None
    np.testing.assert_allclose(trajectory.reference_from_camera, [origin @ p for p in poses], atol=1e-9)
    assert truth is not None
    assert [o.name for o in truth.objects] == ["obj_000007", "obj_000012"]
    assert [o.visible_fraction for o in truth.objects] == [0.75, 1.0]
    for true_object, thing in zip(truth.objects, things, strict=True):
        np.testing.assert_allclose(true_object.world_from_object, origin @ thing, atol=1e-9)


def test_bop_objects_that_move_place_no_camera(tmp_path, recording_path):
    """If the objects do not agree on the camera's motion, only the first frame has a truth; it is said."""
    write_bop(tmp_path, with_world=False, still=False)
    (remark,) = run("bop", tmp_path, recording_path)
    trajectory = recorded_trajectory(recording_path)
    assert "2 frames have no camera truth" in remark
    assert trajectory is not None
    assert trajectory.times_ns[0] == 0


def test_bop_truth_is_of_all_frames(tmp_path, recording_path):
    """What the first frame leaves out is placed by the next; copies are told apart by their places."""
    _, things = write_bop(tmp_path, with_world=True)
    objects, infos = (json.loads((tmp_path / f"scene_{name}.json").read_text()) for name in ("gt", "gt_info"))
    for key in ("5", "10"):
        objects[key] = [{**objects[key][1], "obj_id": 7}, *objects[key]]
        infos[key] = [{"visib_fract": 0.5}, *infos[key]]
    objects["0"], infos["0"] = objects["0"][:1], infos["0"][:1]
    for name, content in {"gt": objects, "gt_info": infos}.items():
        (tmp_path / f"scene_{name}.json").write_text(json.dumps(content))
    assert run("bop", tmp_path, recording_path) == ()
    truth = recorded_scene_truth(recording_path)
    assert truth is not None
    assert [o.name for o in truth.objects] == ["obj_000007", "obj_000007_2", "obj_000012"]
    assert [o.visible_fraction for o in truth.objects] == [0.75, None, None]
    for true_object, thing in zip(truth.objects, things[[0, 1, 1]], strict=True):
        np.testing.assert_allclose(true_object.world_from_object, thing, atol=1e-9)


def test_bop_objects_that_move_are_no_truth(tmp_path, recording_path):
    """Where the world is known, they are left out, which is said; the cameras keep their poses."""
    write_bop(tmp_path, with_world=True, still=False)
    (remark,) = run("bop", tmp_path, recording_path, intrinsics=(500, 500, 3.5, 2.5))
    truth, trajectory = recorded_scene_truth(recording_path), recorded_trajectory(recording_path)
    assert remark == "left out of the true scene, as they do not stand still: obj_000012"
    assert truth is not None
    assert [o.name for o in truth.objects] == ["obj_000007"]
    assert trajectory is not None
    assert len(trajectory) == 3


def test_some_frames_only(tmp_path, recording_path):
    """The truth of chosen frames is that of the first of them."""
    poses, things = write_bop(tmp_path, with_world=False)
    run("bop", tmp_path, recording_path, frames=slice(1, 2))
    truth = recorded_scene_truth(recording_path)
    assert len(open_recording(recording_path)) == 1
    assert truth is not None
    expected = np.linalg.inv(poses[1]) @ things[0]
    np.testing.assert_allclose(truth.objects[0].world_from_object, expected, atol=1e-9)


def bag_messages() -> list[tuple[str, object, int]]:
    """Two frames with camera and pose."""
    pixels = depths(1)[0].astype(np.uint16)
    return [
        (topic, message, stamp)
        for stamp in (SECOND_NS, 2 * SECOND_NS)
        for topic, message in {
            "/c/camera_info": camera_info(stamp, (8, 6), (500.0, 501.0, 3.5, 2.5)),
            "/c/depth": image(stamp, "16UC1", pixels),
            "/tf": transform(stamp, "map", "camera", (stamp / SECOND_NS, 0, 0)),
            "/chatter": STORE.types["std_msgs/msg/String"](data="hello"),
        }.items()
    ]


def write_ros1(path: Path) -> None:
    """A ROS 1 bag, whose headers have a sequence number."""
    with Rosbag1Writer(path) as writer:
        connections = {}
        for topic, message, stamp in bag_messages():
            name = message.__msgtype__  # type: ignore[attr-defined]
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=ROS1_STORE)
            writer.write(connections[topic], stamp + 5, ros1_bytes(message))


def write_ros2(path: Path) -> None:
    """A rosbag2 folder in SQLite."""
    with Rosbag2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {}
        for topic, message, stamp in bag_messages():
            name = message.__msgtype__  # type: ignore[attr-defined]
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=STORE)
            data = bytes(STORE.serialize_cdr(message, name))
            writer.write(connections[topic], stamp + 5, data)


def test_the_unit_of_depth_comes_with_a_realsense_bag(tmp_path, recording_path):
    """Of all numbers in it the one that a recording uses; the others are named as left out."""
    with Rosbag1Writer(tmp_path / "r.bag") as writer:
        for option, value in {"Depth Units": 0.0001, "Exposure": 8500.0}.items():
            topic, name = f"/device_0/sensor_0/option/{option}/value", "std_msgs/msg/Float32"
            message = ROS1_STORE.types[name](data=value)
            connection = writer.add_connection(topic, name, typestore=ROS1_STORE)
            writer.write(connection, 1, bytes(ROS1_STORE.serialize_ros1(message, name)))
        pixels = np.full((6, 8), 1500, np.uint16)
        depth = image(SECOND_NS, "mono16", pixels, "0")
        topic = "/device_0/sensor_0/Depth_0/image/data"
        connection = writer.add_connection(topic, depth.__msgtype__, typestore=ROS1_STORE)
        writer.write(connection, SECOND_NS, ros1_bytes(depth))
    (remark,) = run("bag", tmp_path / "r.bag", recording_path)
    (frame,) = open_recording(recording_path, ReadOptions(intrinsics=(9.0, 9.0, 3.5, 2.5)))

    assert "Exposure" in remark
    assert "Depth Units" not in remark
    np.testing.assert_allclose(frame.depth_m, 0.15)


def test_a_topic_of_two_types_keeps_both(tmp_path, recording_path):
    """As in bags that were merged: each message is read as what it is."""
    pixels, packed = depths(1)[0].astype(np.uint16), io.BytesIO()
    Image.fromarray(pixels).save(packed, "PNG")
    with Rosbag1Writer(tmp_path / "b.bag") as writer:
        for message in (
            image(SECOND_NS, "16UC1", pixels),
            compressed_image(2 * SECOND_NS, "16UC1; png compressed", packed.getvalue()),
        ):
            connection = writer.add_connection("/c/depth", message.__msgtype__, typestore=ROS1_STORE)
            writer.write(connection, SECOND_NS, ros1_bytes(message))
    run("bag", tmp_path / "b.bag", recording_path)
    recording = open_recording(recording_path, ReadOptions(intrinsics=(9.0, 9.0, 3.5, 2.5)))

    assert [frame.time_ns for frame in recording] == [SECOND_NS, 2 * SECOND_NS]
    assert not recording.problems


@pytest.mark.parametrize(("name", "write"), [("b.bag", write_ros1), ("b", write_ros2)])
def test_bags(name, write, tmp_path, recording_path):
    """ROS 1 and ROS 2 bags give the same recording; what a recording does not use is named."""
    write(tmp_path / name)
    (remark,) = run("bag", tmp_path / name, recording_path)
    frames, trajectory = list(open_recording(recording_path)), recorded_trajectory(recording_path)

    assert "/chatter" in remark
    assert camera_of(recording_path) == (500, 501, 3.5, 2.5)
    assert [frame.time_ns for frame in frames] == [SECOND_NS, 2 * SECOND_NS]
    for frame in frames:
        np.testing.assert_array_equal(frame.depth_m, (depths(1)[0] / 1000).astype(np.float32))
    assert trajectory is not None
    np.testing.assert_array_equal(trajectory.reference_from_camera[:, 0, 3], [1, 2])


@pytest.mark.parametrize("format_", ["tum", "7scenes", "redwood", "bop", "bag"])
def test_sources_of_another_kind_are_one_clear_line(format_, tmp_path, recording_path):
    """Missing and foreign sources leave nothing behind."""
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "scene_camera.json").write_text("[[[")
    (foreign / "x.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    for source in (tmp_path / "nowhere", foreign, foreign / "x.bag"):
        with pytest.raises(RecordingError):
            run(format_, source, recording_path)
        assert not recording_path.exists()
        assert not recording_path.with_name(recording_path.name + ".partial").exists()


def test_damaged_sources_leave_nothing_behind(tmp_path, recording_path):
    """A damaged image in the middle, or one of another size, stops the import with its name."""
    for i, pixels in enumerate(depths(4)):
        png(tmp_path / f"frame-{i:06d}.depth.png", pixels)
    damaged = tmp_path / "frame-000002.depth.png"
    for content in (damaged.read_bytes()[:50], b"", struct.pack("<I", 7)):
        damaged.write_bytes(content)
        with pytest.raises(RecordingError, match=r"frame-000002\.depth\.png"):
            run("7scenes", tmp_path, recording_path)
    png(damaged, depths(1)[0][:4])
    with pytest.raises(RecordingError, match=r"frame-000002\.depth\.png is 8x4 where the first is 8x6"):
        run("7scenes", tmp_path, recording_path)
    assert list(tmp_path.glob("*.mcap*")) == []
