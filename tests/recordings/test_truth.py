"""The true scene goes through a file unchanged."""

import json

import jsonschema
import numpy as np
import pytest
from mcap.reader import make_reader

from recordings.dataset_numbers import NUMBERS_TOPIC, recorded_dataset_numbers
from recordings.errors import RecordingError
from recordings.json_topics import json_messages
from recordings.message_schemas import json_schema
from recordings.truth import (
    TRUTH_TOPIC,
    SceneTruth,
    TrueObject,
    recorded_scene_truth,
    write_scene_truth,
)
from recordings.writer import RecordingWriter

TRUTH = SceneTruth(
    objects=(
        TrueObject(
            name="mug 1",
            shape="mug",
            world_from_object=np.eye(4),
            vertices_m=np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]),
            faces=np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32),
            parent="box",
            contact_faces=("+z", "-z"),
            visible_fraction=0.5,
        ),
        TrueObject(name="box", shape="box", world_from_object=np.diag([1.0, -1, -1, 1])),
    ),
    support_plane=np.array([0.0, 0, 1, -0.7]),
)


def test_truth_comes_back(recording_path):
    """Names, poses, surfaces, contacts and the plane are read as they were written."""
    with RecordingWriter(recording_path) as writer:
        write_scene_truth(writer, TRUTH, 7)
    found = recorded_scene_truth(recording_path)

    assert found is not None
    assert found.to_json() == TRUTH.to_json()
    assert found.objects[0].faces is not None
    assert found.objects[0].faces.dtype == np.int32


def test_truth_obeys_its_schema(recording_path):
    """The JSON Schema in the file describes the message beside it."""
    with RecordingWriter(recording_path) as writer:
        write_scene_truth(writer, TRUTH, 7)
    with recording_path.open("rb") as file:
        ((schema, _, _),) = make_reader(file).iter_messages()
    ((time_ns, message),) = json_messages(recording_path, TRUTH_TOPIC)

    assert time_ns == 7
    assert schema is not None
    json_schema = json.loads(schema.data)
    jsonschema.Draft202012Validator.check_schema(json_schema)
    jsonschema.validate(message, json_schema)


def test_no_truth_is_none(recording_path, camera):
    """A recording without the topic has no truth."""
    with RecordingWriter(recording_path, camera):
        pass
    assert recorded_scene_truth(recording_path) is None


@pytest.mark.parametrize(
    "fields",
    [
        {"world_from_object": [[10**400, 0, 0, 0]] * 4},
        {"faces": [[0, 1, 3_000_000_000]]},
        {"faces": [[0, 1, 3]]},
        {"faces": [[0, 1, -1]]},
        {"faces": [[0, 0.5, 2]]},
        {"faces": [[0, 1, 2]], "vertices_m": None},
        {"contact_faces": []},
        {"contact_faces": ["+z", "-z", "-x"]},
        {"contact_faces": ["+z", 1]},
        {"parent": 3},
        {"visible_fraction": "much"},
        {"visible_fraction": float("nan")},
        {"visible_fraction": True},
    ],
)
def test_values_that_no_object_has_are_our_error(fields):
    """Numbers beyond all bounds, faces of corners that are not there, words for numbers: one line each."""
    sound = {"name": "a", "shape": "a", "world_from_object": np.eye(4).tolist()}
    sound |= {"vertices_m": np.eye(3).tolist(), "faces": [[0, 1, 2.0]]}
    assert SceneTruth.from_json({"objects": [sound]}).objects[0].faces is not None
    with pytest.raises(RecordingError, match="no scene truth"):
        SceneTruth.from_json({"objects": [sound | fields]})


def test_numbers_of_a_data_set_that_are_infinite_are_our_error(recording_path):
    """JSON of Python may hold them."""
    with RecordingWriter(recording_path) as writer:
        content = b'{"scene_id": Infinity, "image_ids": {}, "object_ids": {}}'
        writer.write(NUMBERS_TOPIC, json_schema("numbers", {}), content, 7)
    with pytest.raises(RecordingError, match=f"{NUMBERS_TOPIC} is malformed"):
        recorded_dataset_numbers(recording_path)


@pytest.mark.parametrize("message", [{}, {"objects": 3}, {"objects": [{"name": "a"}]}])
def test_malformed_truth_is_our_error(message):
    """What is not a scene is refused in one line."""
    with pytest.raises(RecordingError, match="no scene truth"):
        SceneTruth.from_json(message)
