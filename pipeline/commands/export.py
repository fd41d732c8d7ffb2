"""`voxscene export`: learned shapes and runs in the formats that other programs take."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pipeline.errors import ConfigError
from pipeline.options import AnyPath, Common, common_options, only_for

DEFAULT_FORMATS = "ply,glb"
WITH_UNITS = ("ply", "obj", "stl")
"""Formats whose readers are told no units."""
SURFACES = (*WITH_UNITS, "glb")
OVERLAY = "overlay"
"""A picture, where the other formats are models."""


@click.command(name="export")
@click.argument("source", metavar="SHAPE.npz|DIR|RUN", type=AnyPath())
@click.option(
    "--format",
    "formats",
    default=DEFAULT_FORMATS,
    show_default=True,
    metavar="FORMAT,...",
    help="npz, ply, obj, glb, stl, bop (BOP data set), urdf, mjcf (simulators), overlay (picture of a RUN).",
)
@click.option("-o", "--output", type=AnyPath(), required=True, metavar="DIR")
@click.option("--units", type=click.Choice(["m", "mm"]), help="Of shapes in ply, obj and stl; m by default.")
@click.option(
    "--origin",
    type=click.Choice(["base", "middle", "grid"]),
    default="base",
    show_default=True,
    help="Of learned shapes: centre of the footprint, of the bounding box, or the grid's corner.",
)
@click.option(
    "--unseen",
    type=click.Choice(["fill", "open"]),
    default="fill",
    show_default=True,
    help="Of learned shapes: close the surface behind what was seen, or leave it open there.",
)
@click.option("--shells", is_flag=True, help="Also the surfaces where the probability is 0.1 and 0.9.")
@click.option(
    "--ids",
    type=AnyPath(),
    metavar="FILE.json",
    help="Ids of shapes in BOP's files, {\"mug\": 14}; the run's own, or the next that are free, otherwise.",
)
@click.option(
    "--density",
    type=click.FloatRange(min=0, min_open=True),
    metavar="KG_PER_M3",
    help="Of shapes in urdf and mjcf; 1000, that of water, by default.",
)
@click.option(
    "--mesh",
    is_flag=True,
    help="Of the RUN of one recording: the room as coloured triangles instead of points.",
)
@click.option(
    "--pitch",
    "pitch_m",
    type=click.FloatRange(0.002, 0.2),
    metavar="METRES",
    help="Detail of the room's triangles; 0.01 by default.",
)
@click.option(
    "--recording",
    type=AnyPath(),
    metavar="REC",
    help="What RUN was made from, where --mesh and overlay do not find it by themselves.",
)
@click.option(
    "--truth",
    type=AnyPath(),
    metavar="REC",
    help="Of overlay: outlines of the true poses in REC as well.",
)
@click.option("--force", is_flag=True, help="Replace files in DIR that say something else.")
@common_options()
def command(
    common: Common,
    source: Path,
    formats: str,
    output: Path,
    units: Any,
    origin: Any,
    unseen: Any,
    shells: bool,
    ids: Path | None,
    density: float | None,
    mesh: bool,
    pitch_m: float | None,
    recording: Path | None,
    truth: Path | None,
    force: bool,
) -> None:
    """Write learned shapes, or what a RUN found, for other programs.

    Of a SHAPE.npz or a DIR of them, every shape in every format. Of a RUN, the room with its objects where
    they stand (ply, glb; in metres, in the camera of the first frame used), and its objects one by one in the
    other formats; of a project's run, all of it. To export one learned object, name RUN/shapes/NAME.npz.
    An overlay is the parsed image with the outlines of what was found, hidden edges dotted.

    A manifest.json with them says what is what. Surfaces of shapes are closed and wound outward, with
    enclosed voxels filled. Meshes are in metres unless --units says otherwise; BOP is in millimetres, GLB in
    metres with y up, by their own rules. Files of earlier exports are never overwritten by others.
    """
    from pipeline.bop_numbers import read_ids
    from pipeline.export.model_export import MODEL_FORMATS, SOLIDS, ExportOptions
    from pipeline.export.room_mesh import PITCH_M
    from pipeline.export.run_export import SCENE_FORMATS
    from pipeline.export.run_room import run_room
    from pipeline.export.simulators import DENSITY_KG_M3
    from pipeline.export.sources import export, is_run, shape_names

    wanted = tuple(dict.fromkeys(part.strip() for part in formats.split(",")))
    for form in wanted:
        if form not in (*MODEL_FORMATS, OVERLAY):
            raise ConfigError(f"--format {form}: write some of {', '.join((*MODEL_FORMATS, OVERLAY))}")
    models = tuple(form for form in wanted if form != OVERLAY)
    if unseen == "open" and (solids := sorted(set(wanted) & SOLIDS)):
        raise ConfigError(f"--unseen open: {solids[0]} needs closed surfaces; leave it out")
    _refuse_unused(set(wanted), scene=is_run(source), room=mesh or pitch_m is not None)
    if (mesh or pitch_m or recording or OVERLAY in wanted) and not is_run(source):
        raise ConfigError("--mesh, --pitch, --recording and overlay are for the run of one recording")
    if (mesh or pitch_m) and not set(wanted) & set(SCENE_FORMATS):
        raise ConfigError(f"--mesh writes the room as {' or '.join(SCENE_FORMATS)}: name one in --format")
    numbers = read_ids(ids)
    unknown = sorted(set(numbers) - shape_names(source)) if numbers else []
    if unknown:
        raise ConfigError(f"{ids}: {source} has no shape {unknown[0]!r}")
    options = ExportOptions(
        units=units or "m",
        origin=origin,
        shells=shells,
        unseen=unseen,
        ids=numbers,
        density=density or DENSITY_KG_M3,
        force=force,
    )
    room = run_room(source, recording, pitch_m or PITCH_M, common) if mesh or pitch_m else None
    paths = export(source, models, output, options, room) if models else []
    if OVERLAY in wanted:
        from pipeline.figures.run_overlay import export_overlay

        paths += export_overlay(source, output, recording, truth, force=force)
    lines = [str(path) for path in paths]
    lines += _seen_shares(output) if models else []
    if room is not None:
        lines.append(f"room: {len(room.faces)} triangles")
    common.report({"files": [str(path) for path in paths]}, lines)


def _refuse_unused(wanted: set[str], *, scene: bool, room: bool) -> None:
    """Refuse options that say nothing of any of the formats.

    Args:
        wanted: formats.
        scene: the source is the run of one recording, whose ply and glb are a scene in a frame of its own.
        room: the room is written as triangles.

    Raises:
        ConfigError: one was written.
    """
    from pipeline.export.model_export import SIMULATORS
    from pipeline.export.run_export import SCENE_FORMATS

    one_by_one = wanted - set(SCENE_FORMATS) if scene else wanted
    what = " of shapes one by one" if scene else ""
    if one_by_one.isdisjoint(WITH_UNITS):
        only_for(f"{', '.join(WITH_UNITS)}{what}", "units")
    if one_by_one.isdisjoint(SURFACES):
        only_for(f"{', '.join(SURFACES)}{what}", "shells")
    if one_by_one.isdisjoint((*SURFACES, *SIMULATORS)):
        only_for(f"{', '.join((*SURFACES, *sorted(SIMULATORS)))}{what}", "origin")
    if wanted.isdisjoint(SIMULATORS):
        only_for(" and ".join(sorted(SIMULATORS)), "density")
    if "bop" not in wanted:
        only_for("bop", "ids")
    if OVERLAY not in wanted:
        only_for(OVERLAY, "truth")
        if not room:
            only_for(f"--mesh and {OVERLAY}", "recording")


def _seen_shares(output: Path) -> list[str]:
    """How much of each learned surface was seen, as the manifest has it."""
    from pipeline.export.files import manifest_entries

    return [
        f"{name}: {shape['surface']['seen']:.0%} of the surface seen, {shape['surface']['inferred']:.0%} "
        f"inferred, {shape['surface']['never_seen']:.0%} never seen"
        for name, shape in manifest_entries(output)["shapes"].items()
        if "surface" in shape
    ]
