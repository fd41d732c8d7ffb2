"""`voxscene synth air`: colour images of things on a plain table."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.errors import PipelineError
from pipeline.options import AnyPath, Common, common_options, image_size


@click.command(name="air")
@click.argument("out", type=AnyPath(file_okay=False))
@click.option("--scenes", type=click.IntRange(min=1), default=40, show_default=True)
@click.option("--size", metavar="WIDTHxHEIGHT", default="64x64", show_default=True, help="Image size.")
@common_options(computes=True)
def command(common: Common, out: Path, scenes: int, size: str) -> None:
    """Photograph simple things on a table, into OUT.

    One colour frame for each recording: 0 to 3 balls, cubes, cylinders and mugs. The scenes are those of
    `bench air`, numbered from --seed on: colours in 8 bits, depth without any return, the truth in the file.
    """
    from pipeline.quiet_stdout import stdout_to_stderr
    from pipeline.synthesis.air import air_scene, air_world, write_air_scene

    if out.is_dir() and any(out.iterdir()):
        raise PipelineError(f"{out} is not empty; name a new folder")
    out.mkdir(parents=True, exist_ok=True)
    document = []
    with stdout_to_stderr(), common.progress("air", "scenes") as progress:
        world = air_world(*image_size(size))
        for index in range(scenes):
            scene = air_scene(world, common.seed + index)
            path = out / f"air_{common.seed + index:06d}.mcap"
            write_air_scene(world, scene, path)
            names = [world.kinds[kind].name for kind in scene.truth.kinds]
            document.append({"path": str(path), "things": names})
            progress(index + 1, scenes)
    common.report(document, [f"{one['path']}: {', '.join(one['things']) or 'nothing'}" for one in document])
