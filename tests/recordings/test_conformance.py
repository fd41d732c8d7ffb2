"""The conformance files of the MCAP project: both ways of reading report what the files hold."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from recordings.mcap_files import mcap_file
from recordings.mcap_files.attachments import attachment_data
from recordings.mcap_files.index import FileIndex
from recordings.mcap_files.recovery import rebuild_index
from recordings.mcap_files.sources import open_source
from recordings.mcap_files.summary import index_of_summary, read_summary


@pytest.fixture(scope="module")
def conformance_files(shared_data: Path) -> list[Path]:
    """All 416 files."""
    files = sorted((shared_data / "mcap_conformance").rglob("*.mcap"))
    assert len(files) == 416
    return files


def expected_records(path: Path) -> dict[str, list[dict[str, Any]]]:
    """The records of NAME.json by kind; strings for numbers, lists of strings for bytes, as it has them."""
    records: dict[str, list[dict[str, Any]]] = {}
    for record in json.loads(path.with_suffix(".json").read_text())["records"]:
        records.setdefault(record["type"], []).append(dict(record["fields"]))
    return records


def as_bytes(numbers: list[str]) -> bytes:
    """The bytes that NAME.json spells as numbers."""
    return bytes(map(int, numbers))


def assert_definitions(index: FileIndex, expected: dict[str, list[dict[str, Any]]]) -> None:
    """Schemas and channels are those of the file."""
    assert {(s.id, s.name, s.encoding, s.data) for s in index.schemas.values()} == {
        (int(s["id"]), s["name"], s["encoding"], as_bytes(s["data"])) for s in expected.get("Schema", [])
    }
    assert {
        (c.id, c.topic, c.message_encoding, c.schema_id, *c.metadata.items()) for c in index.channels.values()
    } == {
        (int(c["id"]), c["topic"], c["message_encoding"], int(c["schema_id"]), *c["metadata"].items())
        for c in expected.get("Channel", [])
    }


def assert_attachments(path: Path, index: FileIndex, expected: dict[str, list[dict[str, Any]]]) -> None:
    """Attachments and their content are those of the file."""
    with open_source(path) as source:
        assert [
            (one.name, one.media_type, one.log_time_ns, attachment_data(source, one))
            for one in index.attachments
        ] == [
            (a["name"], a["media_type"], int(a["log_time"]), as_bytes(a["data"]))
            for a in expected.get("Attachment", [])
        ]


def assert_messages(path: Path, index: FileIndex, expected: dict[str, list[dict[str, Any]]]) -> None:
    """Messages are those of the file, none is lost, and the statistics agree."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mcap_file, "_index", lambda _: index)
        file = mcap_file.McapFile(path)
    found = [(message.topic.name, message.log_time_ns, message.data) for message in file.messages()]
    topics = {int(channel["id"]): channel["topic"] for channel in expected.get("Channel", [])}
    assert found == [
        (topics[int(m["channel_id"])], int(m["log_time"]), as_bytes(m["data"]))
        for m in expected.get("Message", [])
    ]
    assert (file.lost_messages, file.losses) == (0, ())
    for statistics in expected.get("Statistics", []):
        counts = {topics[int(id_)]: int(n) for id_, n in statistics["channel_message_counts"].items()}
        assert Counter(topic for topic, *_ in found) == counts


def test_recovery_reports_every_record(conformance_files):
    """Reading from front to end finds all schemas, channels, messages and attachments."""
    for path in conformance_files:
        with open_source(path) as source:
            index = rebuild_index(source)
        expected = expected_records(path)
        assert_definitions(index, expected)
        assert_attachments(path, index, expected)
        assert_messages(path, index, expected)


def test_the_indexed_path_reports_every_record(conformance_files):
    """Reading by the summary finds the same, wherever the summary lists every chunk and channel.

    Where it does not, the whole file is read instead; the count of such files is stated here. They
    have no chunks, or their summary lacks the statistics, the chunk index or the repeated channels.
    """
    declined = Counter()
    for path in conformance_files:
        expected = expected_records(path)
        with open_source(path) as source:
            summary = read_summary(source)
            index = index_of_summary(source, summary) if summary else None
        if index is None:
            declined[_reason(path)] += 1
            continue
        if "ax" not in _features(path):
            expected.pop("Attachment", None)
        assert_definitions(index, expected)
        assert_attachments(path, index, expected)
        assert_messages(path, index, expected)
    assert None not in declined
    assert len(conformance_files) - sum(declined.values()) == 24


def test_opening_reports_every_message(conformance_files):
    """What a user opens gives every message, whichever way was taken."""
    for path in conformance_files:
        expected = expected_records(path)
        assert_messages(path, mcap_file.McapFile(path).index, expected)


def _features(path: Path) -> set[str]:
    return set(path.stem.split("-")[1:])


def _reason(path: Path) -> str | None:
    """Why the summary of a file does not suffice, or None where it should have."""
    features = _features(path)
    for needed, reason in {
        "ch": "no chunks",
        "chx": "no chunk index",
        "st": "no statistics",
        "rch": "no repeated channels",
        "rsh": "no repeated schemas",
    }.items():
        if needed not in features:
            return reason
    return None
