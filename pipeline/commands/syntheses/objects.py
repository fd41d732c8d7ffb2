"""`voxscene synth objects`: films of one object each, to be learned."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pipeline.commands.syntheses.filming import scene_options, scene_settings, write_films
from pipeline.errors import PipelineError
from pipeline.options import Common

if TYPE_CHECKING:
    from pipeline.synthesis.recording import SyntheticRecording


@click.command(name="objects")
@click.option("--object", "names", multiple=True, metavar="NAME", help="Object of each recording in turn.")
@click.option("--support", type=click.Choice(["pedestal", "floating"]), help="Where the object is.")
@scene_options
def command(
    common: Common,
    out: tuple[Path, ...],
    meshes: Path | None,
    units: Any,
    names: tuple[str, ...],
    support: str | None,
    **options: Any,
) -> None:
    """Film one object in each OUT, to be learned.

    The object is --object, else the one that OUT is named after, else one after the other.
    """
    from pipeline.mesh_source import MeshSource
    from pipeline.synthesis.filming import film_object
    from pipeline.synthesis.scenarios import ObjectScene

    scene = common.settings.section("synth", ObjectScene, {"support": support, **scene_settings(**options)})
    shapes = MeshSource.of(meshes, units).meshes
    known = sorted(shapes)

    def film(index: int, path: Path) -> SyntheticRecording:
        name = names[index % len(names)] if names else path.stem
        if name not in shapes:
            if names:
                raise PipelineError(f"no object {name!r}; there are {', '.join(known)}")
            name = known[(common.seed + index) % len(known)]
        return film_object(name, shapes[name], scene, common.seed + index)

    write_films(common, out, film)
