"""`voxscene slam` and `learn` read depth alone: recorded poses and truth are there for `eval`."""

from __future__ import annotations

from pathlib import Path

from click.testing import CliRunner
from mcap.reader import make_reader
from mcap.writer import Writer

from pipeline.commands.learn import command


def _without_poses_and_truth(source: Path, target: Path) -> None:
    """A copy with the images and their cameras alone."""
    with source.open("rb") as reading, target.open("wb") as writing:
        reader, writer = make_reader(reading), Writer(writing)
        writer.start()
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if "camera" not in channel.topic or schema is None:
                continue
            if channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id
                )
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()


def test_truth_and_poses_change_no_byte(mug_file: Path, tmp_path: Path) -> None:
    """Trajectory, uncertainty, shape and summary are the same without the topics that give them away."""
    bare = tmp_path / "bare.mcap"
    _without_poses_and_truth(mug_file, bare)
    assert b"/truth/scene" in mug_file.read_bytes()
    assert b"/truth/scene" not in bare.read_bytes()
    for source, run in ((mug_file, "with"), (bare, "without")):
        options = ["--name", "mug", "--box", "-0.1,-0.1,0.6,0.1,0.1,0.8", "-s", "slam.particles=16"]
        options += ["--every", "3", "--quiet", "-o", str(tmp_path / run)]
        result = CliRunner().invoke(command, [str(source), *options], catch_exceptions=False)
        assert result.exit_code == 0, result.output

    for name in ("slam.npz", "trajectory.tum", "mug.npz", "summary.json"):
        files = [next((tmp_path / run).rglob(name)).read_bytes() for run in ("with", "without")]
        assert files[0] == files[1], name
