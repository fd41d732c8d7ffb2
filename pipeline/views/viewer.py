"""Finding the views of a run, and opening them on a screen."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from pipeline.errors import PipelineError
from pipeline.publishing.values import RunValues
from pipeline.run_folder import RunFolder
from pipeline.views.rrd import write_rrd


def rrds_of(path: Path, *, rebuild: bool = False) -> list[Path]:
    """The run.rrd of a run folder, and of every recording in it; made where it is missing."""
    found = []
    for folder in [path, *sorted(path.glob("recordings/*"))]:
        run = RunFolder(folder, force=False)
        if not run.records():
            continue
        rrd = folder / "run.rrd"
        if rebuild or not rrd.exists():
            write_rrd(rrd, folder.resolve().name, RunValues.load(run).drawable)
        found.append(rrd)
    return found


def open_viewer(rrds: Sequence[Path]) -> None:
    """Open Rerun recordings in the viewer and wait until it is closed.

    Raises:
        PipelineError: there is no screen.
    """
    import rerun_cli

    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise PipelineError(
            "there is no screen here; take a picture with --screenshot OUT.png, "
            f"or open {rrds[0]} with `rerun` on another machine"
        )
    program = Path(rerun_cli.__file__).parent / "rerun"
    subprocess.run([program, *rrds], check=False)
