"""`voxscene synth occlusion`: a box that may hide a mug."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.errors import PipelineError
from pipeline.options import Common, common_options


@click.command(name="occlusion")
@click.argument("out", type=click.Path(path_type=Path, file_okay=False))
@click.option(
    "--width", type=click.IntRange(32, 1024), default=320, show_default=True, help="Of images, pixels; 4:3."
)
@common_options()
def command(common: Common, out: Path, width: int) -> None:
    """Photograph the three scenes of the supplement's Fig. 7, into OUT.

    One depth frame for each recording: a box turned, wide and closer, and no mug. Every pixel returns: 2 m
    where there is nothing, anything in a tenth of them. The truth is in the file.
    """
    from pipeline.quiet_stdout import stdout_to_stderr
    from pipeline.synthesis.objects import built_in_object
    from pipeline.synthesis.occlusion import (
        SCENES,
        box_pose,
        hidden_fraction,
        occlusion_camera,
        occlusion_scene,
        write_occlusion_scene,
    )

    if out.is_dir() and any(out.iterdir()):
        raise PipelineError(f"{out} is not empty; name a new folder")
    out.mkdir(parents=True, exist_ok=True)
    meshes = {"box": built_in_object("box")}
    document = []
    with stdout_to_stderr():
        for number, (name, (yaw_deg, distance_m)) in enumerate(SCENES.items()):
            poses = {"box": box_pose(yaw_deg, 0.0, distance_m)}
            scene = occlusion_scene(name, meshes, poses, occlusion_camera(width), [common.seed, number])
            path = out / f"occlusion_{name}.mcap"
            write_occlusion_scene(scene, meshes, path)
            document.append({"path": str(path), "hidden_fraction": hidden_fraction(scene)})
    common.report(
        document, [f"{one['path']}: {one['hidden_fraction']:.1%} of the volume hidden" for one in document]
    )
