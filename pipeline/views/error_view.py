"""Trajectories beside a reference in Rerun: the paths, and how far each is off over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import rerun as rr
import rerun.blueprint as rrb

from pipeline.atomic import as_text, write_bytes

if TYPE_CHECKING:
    from pipeline.evaluation.trajectories import ComparedTrajectory

REFERENCE_COLOUR = (150, 150, 150)
COLOURS = ((255, 196, 64), (91, 155, 213), (130, 200, 110), (239, 131, 84), (190, 120, 210))


def write_error_rrd(path: Path, compared: Sequence[ComparedTrajectory]) -> None:
    """Write the paths and errors of trajectories, the reference of the first in grey.

    Args:
        path: the file.
        compared: beside the reference, ours first.

    Raises:
        PipelineError: the file cannot be written.
    """
    recording = rr.RecordingStream("voxscene", recording_id=as_text(path.resolve().parent.name))
    blueprint = rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="paths", name="Paths, aligned"),
            rrb.TimeSeriesView(origin="error", name="Position error, cm"),
        ),
        collapse_panels=True,
    )
    # To memory: on a full disk Rerun's own file writer hangs, or ends as if all was well.
    memory = recording.memory_recording()
    recording.send_blueprint(blueprint, make_active=False, make_default=True)
    recording.set_log_time_enabled(False)
    strips = rr.LineStrips3D([compared[0].reference[:, :3, 3]], colors=REFERENCE_COLOUR, radii=0.004)
    recording.log("paths/reference", strips, static=True)
    for number, one in enumerate(compared):
        colour, entity = COLOURS[number % len(COLOURS)], one.name.replace(" ", "_")
        strips = rr.LineStrips3D([one.aligned[:, :3, 3]], colors=colour, radii=0.003)
        recording.log(f"paths/{entity}", strips, static=True)
        series = rr.SeriesLines(names=one.name, colors=colour, widths=1.5)
        recording.log(f"error/{entity}", series, static=True)
        recording.send_columns(
            f"error/{entity}",
            indexes=[rr.TimeColumn("time", timestamp=one.times_ns.astype("datetime64[ns]"))],
            columns=rr.Scalars.columns(scalars=100 * one.position_errors_m),
        )
    write_bytes(path, memory.drain_as_bytes())
