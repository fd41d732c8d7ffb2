"""Writes every file that is derived from a run's committed values, and nothing that is up to date."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import tomli_w

from pipeline.atomic import write_json, write_text
from pipeline.publishing.bop_poses import bop_lines
from pipeline.publishing.messages import write_messages
from pipeline.publishing.summary import summary_of, timing_of
from pipeline.publishing.trajectory_files import kitti_lines, tum_lines
from pipeline.publishing.values import RunValues
from pipeline.run_folder import RunFolder
from pipeline.views.rrd import write_rrd

ALWAYS = ("config.toml", "summary.json", "timing.json", "run.mcap", "run.rrd")
"""Derived files of every run."""


def publish(run: RunFolder) -> None:
    """Write config.toml, summary.json, timing.json, trajectory files, run.mcap and run.rrd, each atomically.

    All but timing.json are functions of the committed values alone, so that a resumed run ends with the
    same content as an undisturbed one; and the same bytes, but for Rerun's own.
    """
    state = {name: run.fingerprint(name) for name in run.stages()}
    if _is_published(run, state):
        return
    values = RunValues.load(run)
    settings = _settings(run)
    write_text(run.path / "config.toml", tomli_w.dumps(settings))
    write_json(run.path / "summary.json", summary_of(values))
    write_json(run.path / "timing.json", timing_of(run, values))
    if values.slam is not None:
        write_text(run.path / "trajectory.tum", tum_lines(values.slam.times_ns, values.slam.mean))
        write_text(run.path / "trajectory.kitti", kitti_lines(values.slam.mean))
    if values.scene is not None:
        write_text(run.path / "poses.csv", bop_lines(values))
    write_messages(run.path / "run.mcap", values, settings)
    write_rrd(run.path / "run.rrd", run.path.resolve().name, values)
    write_json(run.path / "stages" / "published.json", state)


def stage_document(run: RunFolder, name: str) -> dict[str, Any]:
    """The object that a command prints with --json: the stage's summary with its timings merged in."""
    values = RunValues.load(run)
    summary, timing = summary_of(values), timing_of(run, values)
    for part in name.split("/"):
        summary, timing = summary[part], timing[part]
    return {**summary, **timing}


def _is_published(run: RunFolder, state: Mapping[str, str]) -> bool:
    """True if every derived file is there, made from the values that are committed now."""
    try:
        published = json.loads((run.path / "stages" / "published.json").read_text())
    except (OSError, ValueError):
        return False
    files = [
        *ALWAYS,
        *(("trajectory.tum", "trajectory.kitti") if "slam" in state else ()),
        *(("poses.csv",) if "parse" in state else ()),
    ]
    return published == state and all((run.path / name).is_file() for name in files)


def _settings(run: RunFolder) -> dict[str, Any]:
    """The settings of every committed stage, a settings file for --config."""
    settings: dict[str, Any] = {}
    for name in run.stages():
        record = run.record(name)
        settings |= record.settings if record else {}
    return settings
