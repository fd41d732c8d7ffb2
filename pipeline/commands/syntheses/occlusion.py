"""`voxscene synth occlusion`: a box that may hide a mug."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.errors import PipelineError
from pipeline.options import AnyPath, Common, common_options


@click.command(name="occlusion")
@click.argument("out", type=AnyPath(file_okay=False))
@click.option("--mug", is_flag=True, help="Let a mug stand behind the box.")
@common_options(computes=True)
def command(common: Common, out: Path, mug: bool) -> None:
    """Film a box that may hide a mug, into OUT.

    On a table, turned, wide and closer, after the supplement's Fig. 7. One frame for each recording, truth in
    the file: was there a mug behind the box? Ask with
    `voxscene parse OUT/occlusion_wide.mcap --shapes DIR --objects box,mug --exact mug`.
    """
    from pipeline.quiet_stdout import stdout_to_stderr
    from pipeline.synthesis.occluded_table import PLACES, occluded_table
    from pipeline.synthesis.writing import write_recording

    if out.is_dir() and any(out.iterdir()):
        raise PipelineError(f"{out} is not empty; name a new folder")
    out.mkdir(parents=True, exist_ok=True)
    document = []
    for name in PLACES:
        path = out / f"occlusion_{name}.mcap"
        with stdout_to_stderr():
            recording = occluded_table(name, common.seed, mug=mug)
            write_recording(recording, path)
        shown = {one.name: one.visible_fraction for one in recording.truth.objects}
        document.append({"path": str(path), "visible_fraction": shown})
    lines = [
        f"{one['path']}: "
        + ", ".join(f"{name} {share:.0%} visible" for name, share in one["visible_fraction"].items())
        for one in document
    ]
    common.report(document, lines)
