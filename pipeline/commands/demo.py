"""`voxscene demo`: everything on synthetic recordings, with the truth beside it."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import click

from pipeline.errors import PipelineError
from pipeline.options import AnyPath, Common, common_options

if TYPE_CHECKING:
    from pipeline.demo import DemoResult


@click.command(name="demo")
@click.option(
    "--out",
    type=AnyPath(),
    default="demo",
    show_default=True,
    metavar="DIR",
    help="Recordings, project and run folder go here; an interrupted demo goes on where it stopped.",
)
@common_options("slam", "learn", "parse")
def command(common: Common, out: Path) -> None:
    """Film five objects, learn them and find them on a table.

    Everything is compared with the truth: ends 0 only if the camera, the shapes and the poses are as good as
    they have to be.
    """
    from pipeline.demo import demonstrate
    from pipeline.timing import timed

    with timed() as timing:
        result = demonstrate(out, common)
    seconds = round(timing.seconds + timing.compile_s, 3)
    common.report({**result.document, "seconds": seconds}, [*_table(result), *_verdict(result, out, seconds)])
    if not result.holds:
        raise PipelineError(f"the demo in {out} ended too far from the truth; please report this table")


def _table(result: DemoResult) -> list[str]:
    lines = ["learned      camera within   shape IoU"]
    lines += [
        f"{name:<12} {one.trajectory_error_cm:>10.2f} cm {one.iou:>11.3f}"
        for name, one in result.learned.items()
    ]
    lines += ["", "on the table      off by   visible"]
    for one in result.parsed:
        off = f"{1000 * one.add_s_m:>7.1f} mm" if one.found else "   missing"
        seen = "" if one.visible_fraction is None else f"{one.visible_fraction:>9.0%}"
        lines.append(f"{one.name:<12} {off:>11} {seen}")
    return lines


def _verdict(result: DemoResult, out: Path, seconds: float) -> list[str]:
    from pipeline.demo import IOU_GATE, NEAR_GATE, TRAJECTORY_GATE_CM

    found = result.document
    gates = [
        ("camera", f"{found['trajectory_error_cm']:.2f} cm at worst", f"at most {TRAJECTORY_GATE_CM:g} cm"),
        ("shapes", f"IoU {found['iou']:.3f} at worst", f"at least {IOU_GATE:g}"),
        ("poses", f"{found['under_1cm']} of {found['objects']} under 1 cm", f"at least {NEAR_GATE}"),
    ]
    return [
        "",
        *(f"{what:<7} {figure} (has to be {wanted})" for what, figure, wanted in gates),
        "",
        f"{'everything holds' if result.holds else 'too far from the truth'}, in {seconds:.0f} s",
        f"look at it: voxscene review {quote(str(out / 'run' / 'recordings' / 'table'))}",
        f"a shape:    voxscene review {quote(str(out / 'run' / 'recordings' / next(iter(result.learned))))}",
        f"your own:   change {out / 'project.toml'}, then voxscene run",
    ]
