"""run.mcap says what the run knows, in messages that other tools read."""

import json
from collections import defaultdict
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from pipeline.publishing.messages import write_messages
from pipeline.publishing.values import RunValues
from recordings.errors import RecordingError
from recordings.images.point_clouds import OPTICAL_FROM_BODY
from recordings.poses.recorded import recorded_trajectory
from recordings.reading import open_recording

WHOLE = (
    "/transforms/map",
    "/transforms/view",
    "/room",
    "/slam/path",
    "/slam/weights",
    "/shapes",
    "/scene",
    "/summary",
)


def read(path: Path) -> dict[str, list]:
    """Messages by topic with their log times, decoded by other people's readers."""
    topics = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.message_encoding == "json":
                assert json.loads(schema.data)["title"] == schema.name
                content = json.loads(message.data)
            else:
                decoder = DecoderFactory().decoder_for("protobuf", schema)
                assert decoder is not None
                content = decoder(message.data)
            topics[channel.topic].append((message.log_time, content))
    return topics


def test_messages_hold_the_values(values: RunValues, tmp_path: Path) -> None:
    """Poses, particles, weights, cloud, voxels, summary, at recording times."""
    write_messages(tmp_path / "run.mcap", values, {"slam": {"particles": 3}})
    topics = read(tmp_path / "run.mcap")
    slam, room = values.slam, values.room
    assert slam is not None
    assert room is not None

    assert [time for time, _ in topics["/transforms/camera"]] == slam.times_ns.tolist()
    for (_, camera), mean in zip(topics["/transforms/camera"], slam.mean, strict=True):
        assert (camera.parent_frame_id, camera.child_frame_id) == ("reference", "camera")
        np.testing.assert_allclose([getattr(camera.translation, axis) for axis in "xyz"], mean[:3, 3])
    assert {len(particles.poses) for _, particles in topics["/slam/particles"]} == {3}
    assert [frame["hypotheses"] for _, frame in topics["/slam/posterior"]] == slam.hypotheses.tolist()
    assert topics["/slam/weights"][0][1]["log_weights"] == slam.log_weights.tolist()
    cloud = topics["/room/cloud"][0][1]
    assert len(cloud.data) == cloud.point_stride * len(room.points_m)
    assert np.frombuffer(cloud.data[:12], "<f4").tolist() == room.points_m[0].tolist()
    assert topics["/summary"][0][1]["slam"]["frames"] == len(slam)


def test_voxels_are_stored_x_fastest(values: RunValues, tmp_path: Path) -> None:
    """Cell (i, j, k) stands at slice k, row j, column i."""
    write_messages(tmp_path / "run.mcap", values, {})
    grid = read(tmp_path / "run.mcap")["/shapes/mug"][0][1]
    shape = values.shapes["mug"]

    assert (grid.column_count, grid.row_count) == (2, 3)
    for index in ((0, 0, 0), (1, 0, 0), (0, 2, 1), (1, 2, 3)):
        at = index[2] * grid.slice_stride + index[1] * grid.row_stride + index[0] * grid.cell_stride
        assert np.frombuffer(grid.data[at : at + 4], "<f4")[0] == shape.phi[index]
    assert grid.data[grid.fields[1].offset] == 1
    assert grid.data[len(grid.data) - grid.cell_stride + grid.fields[1].offset] == 2
    assert grid.pose.position.y == pytest.approx(0.2)


def test_a_scene_is_shown_and_its_samples_are_kept(parsed_run: RunValues, tmp_path: Path) -> None:
    """Found objects alone, posed in the reference frame."""
    write_messages(tmp_path / "run.mcap", parsed_run, {})
    topics = read(tmp_path / "run.mcap")
    scene, slam = parsed_run.scene, parsed_run.slam
    assert scene is not None
    assert slam is not None

    entities = topics["/scene/objects"][0][1].entities
    assert [one.id for one in entities] == ["mug", "box"]
    assert entities[0].texts[0].text == "mug 99%, +- 2 mm?"
    told = {one.key: one.value for one in entities[0].metadata}
    assert told["presence"] == "0.990000"
    assert told["rests on"] == "box 90%"
    place = (slam.mean[2] @ scene.camera_from_object[1])[:3, 3]
    shown = entities[1].triangles[0]
    np.testing.assert_allclose([getattr(shown.pose.position, axis) for axis in "xyz"], place)
    assert (len(shown.points), len(shown.indices)) == (8, 36)
    samples = topics["/scene/samples"][0][1]
    assert np.shape(samples["poses"]) == (6, 3, 7)
    assert samples["parents"][0] == [1, 3, -1]


def test_equal_values_give_equal_bytes(values: RunValues, tmp_path: Path) -> None:
    """No clock and no chance in them."""
    for name in ("a", "b"):
        write_messages(tmp_path / name, values, {"run": {"seed": 1}})

    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("size", [0, 4, 8])
def test_a_damaged_file_is_replaced(values: RunValues, size: int, tmp_path: Path) -> None:
    """From its first byte on, or from its header on: the place is the run's own."""
    write_messages(tmp_path / "run.mcap", values, {})
    whole = (tmp_path / "run.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(whole[:size] + bytes(30))
    write_messages(tmp_path / "run.mcap", values, {})
    assert (tmp_path / "run.mcap").read_bytes() == whole


def test_a_run_that_knows_nothing_yet_is_an_mcap_too(tmp_path: Path) -> None:
    """With an empty summary."""
    write_messages(tmp_path / "run.mcap", RunValues(slam=None, room=None, shapes={}), {})

    assert list(read(tmp_path / "run.mcap")) == ["/summary"]


def test_a_run_is_neither_a_recording_nor_a_truth(values: RunValues, tmp_path: Path) -> None:
    """Its own path, taken for the truth, would have no error; its images are thinned views of a few."""
    write_messages(tmp_path / "run.mcap", values, {})
    for path in (tmp_path, tmp_path / "run.mcap"):
        for read_as in (open_recording, recorded_trajectory):
            with pytest.raises(RecordingError, match="is a run, not a recording; name what it was made from"):
                read_as(path)


def test_the_file_is_what_mcaps_registry_says(
    values: RunValues, parsed_run: RunValues, tmp_path: Path
) -> None:
    """Its profile promises nothing, encodings belong together, and Foxglove's schemas are Foxglove's own."""
    whole = replace(parsed_run, room=values.room, shapes=values.shapes)
    write_messages(tmp_path / "run.mcap", whole, {})
    with (tmp_path / "run.mcap").open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert reader.get_header().profile == ""
    assert summary is not None
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        pairs = {"protobuf": "protobuf", "json": "jsonschema"}
        assert schema.encoding == pairs[channel.message_encoding], channel.topic
        if schema.encoding == "protobuf":
            module = import_module(f"foxglove_schemas_protobuf.{schema.name.removeprefix('foxglove.')}_pb2")
            described = FileDescriptorSet.FromString(schema.data)
            published = FileDescriptorProto()
            module.DESCRIPTOR.CopyToProto(published)
            assert published in described.file, schema.name


def test_what_holds_for_all_of_the_run_is_stamped_with_its_first_frame(
    values: RunValues, parsed_run: RunValues, tmp_path: Path
) -> None:
    """Viewers show the latest message up to the time they are at."""
    whole = replace(parsed_run, room=values.room, shapes=values.shapes)
    write_messages(tmp_path / "run.mcap", whole, {})
    topics = read(tmp_path / "run.mcap")

    assert {len(messages) for name, messages in topics.items() if name.startswith(WHOLE)} == {1}
    assert {messages[0][0] for messages in topics.values()} == {whole.first_ns}
    assert sum(name.startswith(WHOLE) for name in topics) == 12


@pytest.mark.parametrize("has_parent", [False, True])
def test_every_frame_leads_to_the_root_at_every_stamp(
    values: RunValues, parsed_run: RunValues, tmp_path: Path, has_parent: bool
) -> None:
    """Of all messages; z of the map is up; a recording that has a tree of frames joins with it."""
    assert values.room is not None
    room = replace(values.room, frame_id=np.array("optical"), frame_has_parent=np.array(has_parent))
    whole = replace(parsed_run, room=room, shapes=values.shapes)
    write_messages(tmp_path / "run.mcap", whole, {})
    topics = read(tmp_path / "run.mcap")

    transforms = [one for topic in ("map", "view", "camera") for one in topics.pop(f"/transforms/{topic}")]
    parents = {one.child_frame_id: one.parent_frame_id for _, one in transforms}
    assert parents == (
        {"map": "reference", "reference": "optical", "voxscene_view": "optical"}
        if has_parent
        else {"reference": "map", "optical": "reference", "voxscene_view": "optical"}
    )
    moving = {time for time, one in transforms if "optical" in (one.parent_frame_id, one.child_frame_id)}
    for messages in topics.values():
        for time, message in messages:
            stamped = getattr(message, "entities", [message])
            frames = {one.frame_id for one in stamped if hasattr(one, "frame_id")}
            assert frames <= set(parents) | set(parents.values())
            assert not frames or time in moving
    up = Rotation.from_quat([getattr(transforms[0][1].rotation, axis) for axis in "xyzw"]).as_matrix()
    np.testing.assert_allclose((up if has_parent else up.T)[:, 2], whole.up, atol=1e-9)


@pytest.mark.parametrize("has_parent", [False, True])
def test_a_frame_that_looks_along_x_keeps_its_axes(
    values: RunValues, tmp_path: Path, has_parent: bool
) -> None:
    """Of point clouds in a body's frame: it is placed as the recording means it, and the images in it."""
    assert values.slam is not None
    assert values.room is not None
    frame_from_camera = np.linalg.inv(OPTICAL_FROM_BODY)
    about_frame = {"frame_has_parent": np.array(has_parent), "frame_from_camera": frame_from_camera}
    write_messages(tmp_path / "run.mcap", replace(values, room=replace(values.room, **about_frame)), {})
    topics = read(tmp_path / "run.mcap")

    def placed(topic: str) -> np.ndarray:
        transform = topics[f"/transforms/{topic}"][-1][1]
        matrix = np.eye(4)
        xyzw = [getattr(transform.rotation, axis) for axis in "xyzw"]
        matrix[:3, :3] = Rotation.from_quat(xyzw).as_matrix()
        matrix[:3, 3] = [getattr(transform.translation, axis) for axis in "xyz"]
        return matrix

    reference_from_frame = np.linalg.inv(placed("camera")) if has_parent else placed("camera")
    np.testing.assert_allclose(placed("view"), frame_from_camera, atol=1e-12)
    np.testing.assert_allclose(reference_from_frame @ placed("view"), values.slam.mean[-1], atol=1e-6)


def test_values_are_attached_whole(values: RunValues, tmp_path: Path) -> None:
    """So that the file is a record from which a run can be made again."""
    files = {name: tmp_path / Path(name).name for name in ("slam.npz", "stages/sensor.toml")}
    for name, path in files.items():
        path.write_text(f"of {name}")
    write_messages(tmp_path / "run.mcap", values, {}, files)
    with (tmp_path / "run.mcap").open("rb") as file:
        attached = {one.name: (one.media_type, one.data) for one in make_reader(file).iter_attachments()}

    assert attached == {
        "slam.npz": ("application/zip", b"of slam.npz"),
        "stages/sensor.toml": ("application/toml", b"of stages/sensor.toml"),
    }


def test_the_layout_for_foxglove_shows_what_is_there(
    values: RunValues, parsed_run: RunValues, tmp_path: Path
) -> None:
    """Every topic that docs/foxglove-layout.json names is written, and every field that it plots."""
    write_messages(tmp_path / "slam.mcap", values, {})
    write_messages(tmp_path / "parse.mcap", parsed_run, {})
    topics = read(tmp_path / "slam.mcap") | read(tmp_path / "parse.mcap")
    layout = json.loads((Path(__file__).parents[3] / "docs" / "foxglove-layout.json").read_text())
    panels = layout["configById"]

    named = set(panels["3D!room"]["topics"]) | {panels["RawMessages!summary"]["topicPath"]}
    named |= {topic for one in ("depth", "color") for topic in panels[f"Image!{one}"]["imageMode"].values()}
    plotted = [line["value"].split(".") for line in panels["Plot!spread"]["paths"]]
    assert named | {topic for topic, _ in plotted} <= set(topics)
    assert all(field in topics[topic][0][1] for topic, field in plotted)
    frames = {message.child_frame_id for _, message in topics["/transforms/map"]}
    frames |= {message.parent_frame_id for _, message in topics["/transforms/map"]}
    assert panels["3D!room"]["followTf"] in frames
