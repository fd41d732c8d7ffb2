"""`voxscene import`: folders and bags of other programs become recordings."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.options import AnyPath, Common, Intrinsics, common_options
from pipeline.progress import tell


class Frames(click.ParamType):
    """`N` or `FIRST:END` with the meaning of Python's slices."""

    name = "N|FIRST:END"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> slice:
        """The slice."""
        if isinstance(value, slice):
            return value
        first, colon, end = str(value).partition(":")
        try:
            start = int(first) if first else None
            if not colon:
                return slice(start, None if start in {None, -1} else start + 1)  # type: ignore[operator]
            return slice(start, int(end) if end else None)
        except ValueError:
            self.fail(f"{value!r} is neither a number nor FIRST:END", param, ctx)


@click.command(name="import")
@click.argument("format", type=click.Choice(["tum", "7scenes", "redwood", "bop", "bag"]))
@click.argument("source", type=AnyPath(), metavar="SRC")
@click.argument("out", type=AnyPath(dir_okay=False), metavar="OUT.mcap")
@click.option("--frames", type=Frames(), default=":", help="Only these of the frames, counted from 0.")
@click.option("--intrinsics", type=Intrinsics(), help="Camera in pixels, over the one in SRC.")
@common_options()
def command(
    format: str,  # noqa: A002  (click names it after the argument)
    source: Path,
    out: Path,
    frames: slice,
    intrinsics: tuple[float, float, float, float] | None,
    common: Common,
) -> None:
    """Write SRC, of another program, as the recording OUT.mcap.

    \b
    tum      depth.txt, rgb.txt, groundtruth.txt and their images (TUM RGB-D)
    7scenes  frame-NNNNNN.depth.png and .pose.txt (7-Scenes, tsdf-fusion, 3DMatch)
    redwood  depth/*.png, color/*.jpg, trajectory.log (Redwood, Open3D)
    bop      one scene of a BOP data set, or one folder of YCB-Video frames with gt.json
    bag      a ROS 1 .bag, or a rosbag2 folder of any storage

    True camera poses go to /tf, true object poses to /truth/scene.
    """  # noqa: D301  (click reads the \b)
    from recordings.importers.formats import import_recording

    if format == "bag" and (intrinsics is not None or frames != slice(None)):
        raise click.UsageError("a bag is copied whole; give --intrinsics, --start and --end when it is read")
    with common.progress("importing", "messages" if format == "bag" else "frames") as progress:
        remarks = import_recording(
            format, source, out, frames=frames, intrinsics=intrinsics, progress=progress
        )
    for remark in remarks:
        tell(f"voxscene: {remark}", err=True)
    size_mb = out.stat().st_size / 1e6
    common.report({"recording": str(out), "megabytes": size_mb}, [f"wrote {out} ({size_mb:.1f} MB)"])
