"""Options of the commands that film a scene in each of their recordings, and the filming itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pipeline.errors import ConfigError
from pipeline.options import AnyPath, Common, Intrinsics, common_options, image_size, numbers

if TYPE_CHECKING:
    from pipeline.synthesis.recording import SyntheticRecording

Film = Callable[[int, Path], "SyntheticRecording"]


def scene_options(scene: Callable[..., Any]) -> Any:
    """Give a command the options that every filmed scene has."""
    options = [
        click.argument("out", nargs=-1, required=True, type=AnyPath(dir_okay=False)),
        click.option(
            "--meshes",
            type=AnyPath(),
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
        click.option(
            "--colours",
            type=click.Choice(["plain", "painted", "random"]),
            help="Of objects: one colour each or a texture, by name, or a new colour in each sequence.",
        ),
        click.option("--noise-free", is_flag=True, default=None, help="Measure exactly."),
        click.option(
            "--distortion",
            type=float,
            metavar="SD",
            help="Of the field, in 1/m, by which inverse depths err alike in all frames; real ones 0.002.",
        ),
    ]
    scene = common_options("synth", computes=True)(scene)
    for option in reversed(options):
        scene = option(scene)
    return scene


def scene_settings(
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
    colours: str | None,
    noise_free: bool | None,
    distortion: float | None,
) -> Mapping[str, Any]:
    """The options that both kinds of scene share, by the setting that each sets."""
    from recordings.options import ReadOptions

    width, height = image_size(size) if size else (None, None)
    fx, fy, cx, cy = intrinsics or (None,) * 4
    if intrinsics is not None:
        try:
            ReadOptions(intrinsics=intrinsics)
        except ValueError as error:
            raise ConfigError(f"--intrinsics: {error}") from error
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
        "colours": colours,
        "sensor.noise_free": noise_free,
        "sensor.distortion_per_m": distortion,
    }


def write_films(common: Common, out: tuple[Path, ...], film: Film) -> None:
    """Film and write every recording, then tell what is in each."""
    from pipeline.synthesis.writing import write_recording

    repeated = [path for path in out if out.count(path) > 1]
    if repeated:
        raise ConfigError(f"{repeated[0]} is named twice; each sequence needs a file of its own")
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
