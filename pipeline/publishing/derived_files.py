"""The files that a run's values are told in, for people and for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tomli_w

from pipeline.atomic import write_json, write_text
from pipeline.publishing.bop_poses import bop_lines
from pipeline.publishing.messages import write_messages
from pipeline.publishing.summary import summary_of, timing_of
from pipeline.publishing.trajectory_files import path_texts
from pipeline.publishing.values import RunValues
from pipeline.run_folder import RunFolder
from pipeline.stored_profile import StoredProfile
from pipeline.views.rrd import write_rrd

OPTIONAL = ("trajectory.tum", "trajectory.kitti", "lost.txt", "sensor.toml", "poses.csv")
"""Files of stages that a run may not have, or no longer has."""


def write_derived_files(run: RunFolder) -> list[Path]:
    """Write them all, those for programs first; what was derived from stages that are gone is removed.

    Returns:
        What was written.

    Raises:
        PipelineError: a file cannot be written, or a value is from another version.
        RecordingError: run.mcap cannot be written.
    """
    values, settings = RunValues.load(run).drawable, _settings(run)
    texts = {"config.toml": tomli_w.dumps(settings)}
    if values.slam is not None:
        texts |= path_texts(values.slam)
    if values.profile is not None:
        texts["sensor.toml"] = StoredProfile(values.profile).text
    if values.scene is not None:
        texts["poses.csv"] = bop_lines(values)
    for name in set(OPTIONAL) - set(texts):
        (run.path / name).unlink(missing_ok=True)
    for name, text in texts.items():
        write_text(run.path / name, text)
    write_json(run.path / "summary.json", summary_of(values))
    write_json(run.path / "timing.json", timing_of(run, values))
    kept = [run.value_path(name) for name in run.records()]
    files = {path.relative_to(run.path).as_posix(): path for path in kept}
    write_messages(run.path / "run.mcap", values, settings, files)
    write_rrd(run.path / "run.rrd", run.path.resolve().name, values, run.identity)
    return [run.path / name for name in (*texts, "summary.json", "timing.json", "run.mcap", "run.rrd")]


def _settings(run: RunFolder) -> dict[str, Any]:
    """The settings of every committed stage, a settings file for --config."""
    settings: dict[str, Any] = {}
    for record in run.records().values():
        settings |= record.settings
    return settings
