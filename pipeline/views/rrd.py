"""run.rrd: everything that a run knows, ready to open in Rerun."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import rerun as rr

from pipeline.atomic import as_text, write_bytes
from pipeline.colours import object_colours
from pipeline.publishing.summary import summary_of
from pipeline.publishing.values import RunValues
from pipeline.views.blueprint import room_eye, run_blueprint
from pipeline.views.camera_view import log_camera_views, log_frusta, log_room
from pipeline.views.charts import legend, presence_bars
from pipeline.views.labels import Flag, raised
from pipeline.views.report import report_markdown
from pipeline.views.scene_view import flags_of, log_scene
from pipeline.views.shape_view import log_shape
from pipeline.views.trajectory_view import log_filter, log_trajectory
from pipeline.views.truth_view import RunTruth, log_truth

APPLICATION = "voxscene"


def write_rrd(
    path: Path, name: str, values: RunValues, identity: str = "", truth: RunTruth | None = None
) -> None:
    """Write the views of a run as one Rerun recording with its blueprint, whole or not at all.

    Args:
        path: the file.
        name: of the recording, shown by the viewer.
        values: what the run knows.
        identity: of the run. Rerun keeps one blueprint for each application, and merges recordings of one id:
            runs with identities of their own keep their views to themselves.
        truth: to show beside them.

    Raises:
        PipelineError: the file cannot be written.
    """
    own = "-".join(part for part in (APPLICATION, identity) if part)
    recording = rr.RecordingStream(own, recording_id=own, send_properties=True)
    # To memory: on a full disk Rerun's own file writer hangs, or ends as if all was well.
    memory = recording.memory_recording()
    summary, eye, flags = summary_of(values), room_eye(values), dict[str, Flag]()
    if eye is not None and values.scene is not None and values.surfaces is not None:
        flags = flags_of(values, values.scene, values.surfaces, summary["parse"])
        eye, flags = raised(eye, flags)
    # Active too: a browser leaves a blueprint that is but the default aside.
    recording.send_blueprint(
        run_blueprint(values, eye, truth=truth is not None), make_active=True, make_default=True
    )
    recording.set_log_time_enabled(False)
    recording.send_recording_name(as_text(name))
    _log(recording, values, summary, flags, truth)
    write_bytes(path, memory.drain_as_bytes())


def _log(
    recording: rr.RecordingStream,
    values: RunValues,
    summary: Mapping[str, Any],
    flags: Mapping[str, Flag],
    truth: RunTruth | None,
) -> None:
    report = rr.TextDocument(report_markdown(values, summary), media_type="text/markdown")
    recording.log("report", report, static=True)
    if values.slam is not None:
        log_trajectory(recording, values.slam)
        log_filter(recording, values.slam)
    if values.room is not None:
        log_room(recording, values, values.room)
        range_m = log_camera_views(recording, values, values.room)
        log_frusta(recording, values, values.room)
        colours = legend(
            range_m,
            residual=values.room.has_depth,
            path=values.slam is not None,
            shape=bool(values.shapes),
            truth=truth is not None,
        )
        recording.log("legend", rr.Image(colours), static=True)
    if truth is not None:
        log_truth(recording, values, truth)
    for shape_name, shape in values.shapes.items():
        log_shape(recording, shape_name, shape)
    if values.scene is not None and values.surfaces is not None:
        log_scene(recording, values, values.scene, values.surfaces, flags)
        found = object_colours(values.scene.found)
        by_name = {str(values.scene.names[one]): colour for one, colour in found.items()}
        recording.log("presence", rr.Image(presence_bars(summary["parse"], by_name)), static=True)
