"""run.rrd: everything that a run knows, ready to open in Rerun."""

from __future__ import annotations

from pathlib import Path

import rerun as rr

from pipeline.atomic import write_bytes
from pipeline.publishing.values import RunValues
from pipeline.views.blueprint import run_blueprint
from pipeline.views.report import report_markdown
from pipeline.views.scene_view import log_scene
from pipeline.views.shape_view import log_shape
from pipeline.views.trajectory_view import log_camera_views, log_filter, log_room, log_trajectory

APPLICATION = "voxscene"
POINT_M, POINT_AT_TABLE_M = 0.006, 0.0015
"""Radius of the cloud's points in a room, and where posed surfaces must not vanish between them."""


def write_rrd(path: Path, name: str, values: RunValues) -> None:
    """Write the views of a run as one Rerun recording with its blueprint, whole or not at all.

    Args:
        path: the file.
        name: of the recording, shown by the viewer and its id.
        values: what the run knows.

    Raises:
        PipelineError: the file cannot be written.
    """
    recording = rr.RecordingStream(APPLICATION, recording_id=name, send_properties=True)
    # To memory: on a full disk Rerun's own file writer hangs, or ends as if all was well.
    memory = recording.memory_recording()
    recording.send_blueprint(run_blueprint(values), make_active=False, make_default=True)
    recording.set_log_time_enabled(False)
    recording.send_recording_name(name)
    recording.log(
        "report", rr.TextDocument(report_markdown(name, values), media_type="text/markdown"), static=True
    )
    if values.slam is not None:
        log_trajectory(recording, values.slam)
        log_filter(recording, values.slam)
    if values.room is not None:
        log_room(recording, values.room, POINT_M if values.scene is None else POINT_AT_TABLE_M)
    if values.slam is not None and values.room is not None:
        log_camera_views(recording, values.slam, values.room)
    for shape_name, shape in values.shapes.items():
        log_shape(recording, shape_name, shape)
    if values.scene is not None and values.surfaces is not None:
        log_scene(recording, values.scene, values.surfaces.by_name, values.reference_from_parsed)
    write_bytes(path, memory.drain_as_bytes())
