"""`voxscene synth`: recordings made in code, with the truth in the file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pipeline.errors import PipelineError
from pipeline.options import Common, Intrinsics, common_options, image_size, numbers

if TYPE_CHECKING:
    import trimesh

    from pipeline.synthesis.recording import SyntheticRecording

Film = Callable[[int, Path], "SyntheticRecording"]


@click.group(name="synth")
def command() -> None:
    """Synthesise recordings, seeded, with the truth in the file.

    Every parameter of the room, the camera's path and the sensor is a setting, such as
    -s synth.sensor.noise.outlier_probability=0.05.
    """


def _scene_options(scene: Callable[..., Any]) -> Any:
    options = [
        click.argument("out", nargs=-1, required=True, type=click.Path(path_type=Path, dir_okay=False)),
        click.option(
            "--meshes",
            type=click.Path(path_type=Path),
            metavar="DIR",
            help="Meshes instead of the built-in objects.",
        ),
        click.option("--units", type=click.Choice(["m", "mm"]), help="Of the meshes; metres unless BOP's."),
        click.option(
            "--room",
            type=click.Choice(["bare", "furnished", "cluttered", "curved", "none"]),
            help="What surrounds the scene.",
        ),
        click.option("--open-sides", type=click.IntRange(0, 4), help="Walls left out."),
        click.option(
            "--path", type=click.Choice(["orbit", "handheld", "rings"]), help="How the camera moves."
        ),
        click.option("--frames", type=click.IntRange(1), help="Number of views."),
        click.option("--step", type=float, metavar="DEGREES", help="Degrees a frame round the scene."),
        click.option("--radius", type=float, metavar="METRES", help="Distance of the camera."),
        click.option(
            "--elevations", metavar="DEGREES,...", help="Of the camera: one for each ring, or passed through."
        ),
        click.option("--size", metavar="WIDTHxHEIGHT", help="Image size."),
        click.option("--intrinsics", type=Intrinsics(), help="Lens in pixels."),
        click.option("--noise-free", is_flag=True, default=None, help="Measure exactly."),
    ]
    scene = common_options("synth")(scene)
    for option in reversed(options):
        scene = option(scene)
    return scene


@command.command()
@click.option("--object", "names", multiple=True, metavar="NAME", help="Object of each recording in turn.")
@click.option("--support", type=click.Choice(["pedestal", "floating"]), help="Where the object is.")
@_scene_options
def objects(
    common: Common,
    out: tuple[Path, ...],
    meshes: Path | None,
    units: str | None,
    names: tuple[str, ...],
    support: str | None,
    **options: Any,
) -> None:
    """Film one object in each OUT, to be learned.

    The object is --object, else the one that OUT is named after, else one after the other.
    """
    from pipeline.synthesis.filming import film_object
    from pipeline.synthesis.scenarios import ObjectScene

    scene = common.settings.section("synth", ObjectScene, {"support": support, **_settings(**options)})
    shapes = _shapes(meshes, units)
    known = sorted(shapes)

    def film(index: int, path: Path) -> SyntheticRecording:
        name = names[index % len(names)] if names else path.stem
        if name not in shapes:
            if names:
                raise PipelineError(f"no object {name!r}; there are {', '.join(known)}")
            name = known[(common.seed + index) % len(known)]
        return film_object(name, shapes[name], scene, common.seed + index)

    _write(common, out, film)


@command.command()
@click.option("--objects", "count", type=click.IntRange(1), help="Objects on the table.")
@click.option("--only", metavar="NAME,...", help="Draw from these objects alone.")
@click.option(
    "--stacked",
    type=click.FloatRange(0, 1, max_open=True),
    metavar="SHARE",
    help="Least share of objects that rest on another.",
)
@click.option("--clutter", type=click.IntRange(0), help="Unknown things on the table.")
@_scene_options
def scenes(
    common: Common,
    out: tuple[Path, ...],
    meshes: Path | None,
    units: str | None,
    count: int | None,
    only: str | None,
    stacked: float | None,
    clutter: int | None,
    **options: Any,
) -> None:
    """Film a table of objects in each OUT, to be parsed."""
    from pipeline.synthesis.filming import film_table
    from pipeline.synthesis.scenarios import TableScene

    own = {"objects": count, "stacked_share": stacked, "clutter": clutter}
    scene = common.settings.section("synth", TableScene, {**own, **_settings(**options)})
    shapes = _shapes(meshes, units)
    if only:
        missing = sorted(set(only.split(",")) - set(shapes))
        if missing:
            raise PipelineError(f"no object {missing[0]!r}; there are {', '.join(sorted(shapes))}")
        shapes = {name: shapes[name] for name in only.split(",")}
    _write(common, out, lambda index, _: film_table(shapes, scene, common.seed + index))


def _settings(
    *,
    room: str | None,
    open_sides: int | None,
    path: str | None,
    frames: int | None,
    step: float | None,
    radius: float | None,
    elevations: str | None,
    size: str | None,
    intrinsics: tuple[float, float, float, float] | None,
    noise_free: bool | None,
) -> Mapping[str, Any]:
    """The options that both kinds of scene share, by the setting that each sets."""
    width, height = image_size(size) if size else (None, None)
    fx, fy, cx, cy = intrinsics or (None,) * 4
    return {
        "camera.width": width,
        "camera.height": height,
        "camera.fx": fx,
        "camera.fy": fy,
        "camera.cx": cx,
        "camera.cy": cy,
        "room.kind": room,
        "room.open_sides": open_sides,
        "path.kind": path,
        "path.frames": frames,
        "path.degrees_per_frame": step,
        "path.radius_m": radius,
        "path.elevations_deg": numbers("--elevations", elevations) if elevations else None,
        "sensor.noise_free": noise_free,
    }


def _shapes(meshes: Path | None, units: Any) -> Mapping[str, trimesh.Trimesh]:
    from pipeline.meshes import load_meshes
    from pipeline.synthesis.objects import built_in_names, built_in_object

    if meshes:
        return load_meshes(meshes, units)
    return {name: built_in_object(name) for name in built_in_names()}


def _write(common: Common, out: tuple[Path, ...], film: Film) -> None:
    """Film and write every recording, then tell what is in each."""
    from pipeline.jax_setup import keep_compiled_kernels
    from pipeline.synthesis.writing import write_recording

    keep_compiled_kernels()
    document = []
    for index, path in enumerate(out):
        recording = film(index, path)
        with common.progress(path.name, "frames") as progress:
            write_recording(recording, path, progress)
        found = [{"name": one.name, "parent": one.parent} for one in recording.truth.objects]
        document.append({"path": str(path), "frames": len(recording), "objects": found})
    lines = [
        f"{one['path']}: {one['frames']} frames of " + ", ".join(found["name"] for found in one["objects"])
        for one in document
    ]
    common.report(document, lines)
