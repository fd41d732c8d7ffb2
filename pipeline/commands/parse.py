"""`voxscene parse`: which objects stand where, what rests on what, and how sure are we."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import Any

import click

from pipeline.damage import report_damage
from pipeline.errors import ConfigError
from pipeline.options import (
    AnyPath,
    Common,
    RecordingSource,
    common_options,
    numbers,
    only_for,
    recording_options,
    run_options,
)

MOST_FRAMES = 1000
"""All are held in memory and compared at once."""

MENTIONED = 0.05
"""Presence from which the terminal tells where an object may be that was not found."""

IN_SIGHT = 0.005
"""Probability of being in sight, and taken for something else, from which it is told."""

NAMED = 6
"""Of the others that were not found; one line holds them."""

REGIONS = 3
"""Of such an object that the terminal tells."""


class FrameNumbers(click.ParamType):
    """`0`, `0,5,9` or `0:5` (up to and without 5)."""

    name = "FRAMES"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The numbers, as a tuple."""
        text = str(value)
        try:
            if ":" in text:
                low, high = text.split(":")
                if int(high) - int(low or 0) > MOST_FRAMES:
                    self.fail(f"{value!r} names more than {MOST_FRAMES} frames", param, ctx)
                numbers = tuple(range(int(low or 0), int(high)))
            else:
                numbers = tuple(int(part) for part in text.split(","))
        except ValueError:
            numbers = ()
        if not numbers:
            self.fail(f"{value!r} names no frames; write 0, 0,5,9 or 0:5", param, ctx)
        return numbers


@click.command(name="parse")
@run_options
@click.option(
    "--shapes",
    type=AnyPath(),
    required=True,
    metavar="DIR",
    help="Learned shapes (.npz), a RUN that holds some, or meshes (.ply, .obj, .stl, .glb, .off).",
)
@click.option(
    "--units",
    type=click.Choice(["m", "mm"]),
    help="Of meshes; metres by default, millimetres with BOP's models_info.json.",
)
@click.option(
    "--ids",
    type=AnyPath(),
    metavar="FILE.json",
    help='Ids of objects in poses.csv, {"mug": 14}; those of models_info.json or of the recording otherwise.',
)
@click.option(
    "--objects",
    metavar="A,B:2|any",
    help="Requested shapes, B:2 up to two of a kind; any shape once by default.",
)
@click.option(
    "--frames",
    type=FrameNumbers(),
    metavar="N,M,...|N:M",
    help="Depth frames: 0, or 0,5,9, or 0:5 (5 not included), counted after --start, --end and --every; "
    "the first that shows enough by default.",
)
@click.option(
    "--graph",
    type=click.Choice(["infer", "fixed"]),
    help="Infer what rests on what, or let all float; infer by default.",
)
@click.option(
    "--likelihood",
    type=click.Choice(["depth", "cloud"]),
    help="Compare depth images pixel by pixel, or point clouds; depth by default.",
)
@click.option(
    "--shape-samples",
    type=click.IntRange(min=1),
    metavar="R",
    help="Average the likelihood over R random draws of each learned shape; its surface alone by default.",
)
@click.option(
    "--support",
    metavar="X,Y,Z,NX,NY,NZ",
    help="A point and the normal of what objects stand on, in the first camera; found by itself by default.",
)
@click.option(
    "--region",
    metavar="XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX",
    help="Where objects are looked for, metres in the first camera; everywhere by default.",
)
@click.option(
    "--colour",
    type=click.Choice(["off", "add", "only"]),
    help="`add` compares the shapes' colours and depth (lookalikes, the spin of a can); `only` finds what "
    "stands upright on a table in one colour image, without depth; off by default.",
)
@click.option(
    "--table",
    metavar="HEIGHT,PITCH[,ROLL]",
    help="For --colour only: the camera over the table, metres and degrees downwards; by default as the "
    "depth shows it, or as recorded over the plane z = 0.",
)
@click.option(
    "--light",
    metavar="X,Y,Z,AMBIENT",
    help="For --colour only: direction of the light from the table, and the share of ambient light; "
    "estimated by default.",
)
@click.option(
    "--presence",
    type=float,
    metavar="P",
    help="Prior probability that an object is there; 0.5 by default: any number of them is as probable.",
)
@click.option(
    "--exact",
    metavar="A[,B]",
    help="Of one object or two that are not found: the exact probability of being hidden, and where.",
)
@recording_options
@common_options("recording", "parse", "slam")
@click.pass_context
def command(
    ctx: click.Context,
    common: Common,
    source: RecordingSource,
    run_path: Path,
    force: bool,
    shapes: Path,
    units: Any,
    ids: Path | None,
    objects: str | None,
    frames: tuple[int, ...] | None,
    graph: str | None,
    likelihood: str | None,
    shape_samples: int | None,
    support: str | None,
    region: str | None,
    colour: str | None,
    table: str | None,
    light: str | None,
    presence: float | None,
    exact: str | None,
) -> None:
    """Find the objects in REC, their poses and what rests on what.

    Each with its uncertainty. Runs slam first where several frames are used.
    """
    from pipeline.bop_numbers import read_ids
    from pipeline.publishing.publish import stage_document
    from pipeline.publishing.told_spread import verdict_text
    from pipeline.session import open_session
    from pipeline.stages.parse import parse_stage
    from scene.config import ParseConfig

    options = {
        "objects": None if objects is None else _requested(objects),
        "frames": frames,
        "graph": graph,
        "likelihood": likelihood,
        "shape_samples": shape_samples,
        "support": None if support is None else numbers("--support", support),
        "region": None if region is None else numbers("--region", region),
        "colour": colour,
        "table": None if table is None else numbers("--table", table),
        "light": None if light is None else numbers("--light", light),
        "presence": presence,
        "exact": None if exact is None else _names("--exact", exact),
    }
    is_photograph = common.settings.section("parse", ParseConfig, {"colour": colour}).colour == "only"
    if (table or light) and not is_photograph:
        raise ConfigError("--table and --light are for --colour only")
    if is_photograph:
        only_for("a parse of depth", "graph", "likelihood", "shape_samples", "region", "presence")
        source = source.of_colour_alone
    known_ids = read_ids(ids)
    with open_session(common, source, run_path, force=force) as session:
        parse_stage(session, shapes, units, options, known_ids)
        damage = session.damage
    document = stage_document(session.run, "parse")
    lines = [_line(one, document["graph"]) for one in document["objects"]] or ["no object was found"]
    lines += _not_found_lines(document["not_found"])
    lines += [_count_line(one) for one in document["counts"]]
    lines += [
        f"{document['seconds']:.1f} s, compiled in {document['compile_s']:.1f} s{_rates(document)}",
        verdict_text(document),
        f"poses: {run_path / 'poses.csv'}; look at it: voxscene review {quote(str(run_path))}",
    ]
    if shape_samples:
        lines.insert(-1, f"variance of the log likelihood's estimate {document['log_estimate_variance']:.2f}")
    common.report(document, lines)
    ctx.exit(report_damage(source.path, damage))


def _rates(document: dict[str, Any]) -> str:
    """How fast chains ran, where they did."""
    if document["effective_samples"] is None:
        return ""
    rate = document["effective_samples"] / max(document["seconds"], 1e-3)
    return f"; {rate:.1f} effective samples/s, {document['acceptance']:.0%} of moves accepted"


def _names(option: str, text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise ConfigError(f"{option} {text}: write names with commas between them")
    return names


def _requested(text: str) -> tuple[str, ...]:
    """Entries of --objects; none for any."""
    return () if text == "any" else _names("--objects", text)


def _not_found_lines(objects: list[dict[str, Any]]) -> list[str]:
    """Where what was not found may be, and one line of what is improbable."""
    improbable = [one["name"] for one in objects if one["presence"] < MENTIONED]
    lines = [_hidden_line(one) for one in objects if one["presence"] >= MENTIONED]
    if improbable:
        more = f" and {len(improbable) - NAMED} more" if len(improbable) > NAMED else ""
        lines.append(f"not found, presence under {MENTIONED:g}: {', '.join(improbable[:NAMED])}{more}")
    return lines


def _hidden_line(one: dict[str, Any]) -> str:
    """What a person wants to know of an object that was not found, and may be there."""
    text = f"{one['name']}: not found, presence {one['presence']:.3f} +- {one['presence_std']:.3f}"
    if one["in_sight"] >= IN_SIGHT:
        text += f", {one['in_sight']:.2f} of it in sight"
    places = [
        f"{region['probability']:.2f} in ({_corner(region['low_m'])}) to ({_corner(region['high_m'])}) cm"
        for region in one["regions"][:REGIONS]
    ]
    return "; ".join([text, *places])


def _count_line(one: dict[str, Any]) -> str:
    """How many copies of a shape are there: the numbers that are likely enough to be mentioned."""
    said = enumerate(one["probabilities"])
    numbers = ", ".join(f"{number} ({share:.2f})" for number, share in said if share >= MENTIONED)
    return f"{one['name']}, so many of {len(one['probabilities']) - 1}: {numbers}"


def _corner(point_m: list[float]) -> str:
    return ", ".join(f"{100 * metres:.0f}" for metres in point_m)


def _line(one: dict[str, Any], graph: list[dict[str, Any]]) -> str:
    """What a person wants to know of an object."""
    from pipeline.publishing.told_spread import agreement_text, modes_text, position_text, presence_text

    place = ", ".join(f"{metres * 100:.1f}" for metres in one["middle_m"])
    text = f"{one['name']}: ({place}) cm {position_text(one)}, presence {presence_text(one)}"
    edges = {edge["parent"]: edge["probability"] for edge in graph if edge["child"] == one["name"]}
    floating = 1 - sum(edges.values())
    best = max(edges, key=edges.__getitem__, default=None)
    if best is None or edges[best] < floating:
        text = f"{text}, floating ({floating:.2f})"
    else:
        text = f"{text}, on {best} ({edges[best]:.2f})"
    return "; ".join(part for part in (text, agreement_text(one), modes_text(one)) if part)
