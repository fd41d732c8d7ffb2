"""The report on runs: what they found side by side, what calls for care, and each run's pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import PipelineError
from pipeline.export.models import learned_model
from pipeline.export.sources import is_run
from pipeline.publishing.summary import summary_of, timing_of
from pipeline.publishing.told_spread import (
    agreement_text,
    camera_text,
    position_text,
    presence_text,
    rotation_text,
)
from pipeline.publishing.values import RunValues
from pipeline.report import charts
from pipeline.report.page import HEAD, Page
from pipeline.report.pictures import depth_pixels, png, scene_picture, shape_picture
from pipeline.report.warnings import warnings_of
from pipeline.run_folder import RunFolder, is_project
from recordings.types import Damage

TITLE = "voxscene: "
"""How every report's title begins."""
VIEWS = 4
"""Pictures of what the camera saw, of each run."""
CLOUD_POINTS = 60_000
"""More would be drawn over each other."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportedRun:
    """A run with what the report says of it.

    Attributes:
        name: of its folder; of several with one name, with as many folders above as tell them apart.
        path: of the folder.
        values: the committed values.
        summary: as in summary.json.
        timing: as in timing.json.
        warnings: sentences.
    """

    name: str
    path: Path
    values: RunValues
    summary: Mapping[str, Any]
    timing: Mapping[str, Any]
    warnings: Sequence[str]


def report(paths: Sequence[Path], progress: Callable[[int, int], None] | None = None) -> Page:
    """The page on runs and projects.

    Args:
        paths: run folders, of recordings or of projects.
        progress: is told how many runs of how many are done.

    Raises:
        PipelineError: a path is no run, or holds nothing that is finished.
    """
    runs = [reported(path, name) for name, path in _named(_runs(paths))]
    title = runs[0].name if len(runs) == 1 else f"{len(runs)} runs"
    page = Page(f"{TITLE}{title}", "Centres of objects in the camera of each run's first parsed frame.")
    page.chapter("Summary")
    _summary_table(page, runs)
    _all_warnings(page, runs)
    for number, run in enumerate(runs, start=1):
        page.chapter(run.name)
        _camera(page, run)
        _shapes(page, run)
        _objects(page, run)
        _settings(page, run)
        if progress:
            progress(number, len(runs))
    return page


def is_report(path: Path) -> bool:
    """Whether a file begins as reports do."""
    beginning = (HEAD + TITLE).encode()
    with path.open("rb") as file:
        return file.read(len(beginning)) == beginning


def reported(path: Path, name: str) -> ReportedRun:
    """A run with its summary and warnings.

    Raises:
        PipelineError: nothing in it is finished.
    """
    folder = RunFolder(path, force=False)
    stages = folder.records()
    if not stages:
        what = next(iter(folder.changed), "make one with voxscene slam, learn or parse")
        raise PipelineError(f"{path} holds no finished stage; {what}")
    values = RunValues.load(folder).drawable
    summary = summary_of(values)
    lost = [Damage(**record.notes["damage"]) for record in stages.values() if "damage" in record.notes]
    worst = max(lost, key=lambda one: (one.lost_chunks, one.lost_messages), default=Damage())
    return ReportedRun(
        name=name,
        path=path,
        values=values,
        summary=summary,
        timing=timing_of(folder, values),
        warnings=[*(f"{line}." for line in folder.changed), *warnings_of(values, summary, worst)],
    )


def _runs(paths: Sequence[Path]) -> list[Path]:
    """The run folders that paths stand for, those of projects included, each once."""
    found: list[Path] = []
    for path in paths:
        if is_project(path):
            found += sorted(run for run in (path / "recordings").iterdir() if is_run(run))
        elif is_run(path):
            found.append(path)
        else:
            raise PipelineError(f"{path} is no run; make one with voxscene slam, learn, parse or run")
    return list({run.resolve(): run for run in found}.values())


def _named(runs: Sequence[Path]) -> list[tuple[str, Path]]:
    """The runs with the shortest ends of their paths that tell them apart."""
    whole = [run.resolve().parts for run in runs]
    ends = [
        next(own[-n:] for n in range(1, len(own) + 1) if [one[-n:] for one in whole].count(own[-n:]) == 1)
        for own in whole
    ]
    return [("/".join(end), run) for end, run in zip(ends, runs, strict=True)]


def _summary_table(page: Page, runs: Sequence[ReportedRun]) -> None:
    """One column a run, one row a figure that at least one of them has."""
    columns = [_figures(run) for run in runs]
    rows = sorted(dict.fromkeys(row for column in columns for row in column), key=_is_time)
    page.table(
        ["", *(run.name for run in runs)],
        [[row, *(column.get(row, "") for column in columns)] for row in rows],
    )


def _is_time(row: str) -> bool:
    return row.startswith("time of")


def _figures(run: ReportedRun) -> dict[str, str]:
    found: dict[str, str] = {}
    slam = run.values.slam
    if slam is not None:
        seconds = (slam.times_ns[-1] - slam.times_ns[0]) / 1e9
        found["frames"] = f"{len(slam)} in {seconds:.1f} s"
        found["lost frames"] = str(int(slam.lost.sum()))
        found["path length"] = f"{run.summary['slam']['length_m']:.2f} m"
        found["position"] = camera_text(run.summary["slam"]).removeprefix("position ")
        found["largest effective number of hypotheses"] = f"{slam.hypotheses.max():.2g}"
    for name, shape in run.values.shapes.items():
        size = " x ".join(f"{100 * side:.1f}" for side in np.ptp(shape.bounding_box_m, axis=0))
        found[f"shape {name}"] = f"{size} cm"
    parse = run.summary.get("parse")
    if parse is not None:
        found["objects found"] = (
            f"{len(parse['objects'])} of {len(parse['objects']) + len(parse['not_found'])}"
        )
        found["R-hat"] = "" if parse["r_hat"] is None else f"{parse['r_hat']:.2f}"
    for stage in ("slam", "parse"):
        if stage in run.timing:
            found[f"time of {stage}"] = f"{run.timing[stage]['seconds']:.1f} s"
    for name, timing in run.timing.get("learn", {}).items():
        found[f"time of learn {name}"] = f"{timing['seconds']:.1f} s"
    return found


def _all_warnings(page: Page, runs: Sequence[ReportedRun]) -> None:
    several = len(runs) > 1
    for run in runs:
        for sentence in run.warnings:
            page.warning(f"{run.name}: {sentence}" if several else sentence)
    if not any(run.warnings for run in runs):
        page.text("Nothing calls for special care.")


def _camera(page: Page, run: ReportedRun) -> None:
    slam, room = run.values.slam, run.values.room
    pictures: dict[str, bytes] = {}
    if room is not None and len(room.points_m):
        step = -(-len(room.points_m) // CLOUD_POINTS)
        rgb = None if room.rgb is None else room.rgb[::step]
        path = None if slam is None else slam.mean[:, :3, 3]
        points = room.points_m[::step].astype(np.float64)
        pictures["what was seen, from above, and the camera's path"] = charts.cloud(points, rgb, path)
    if slam is not None and len(slam) > 1:
        time_s = (slam.times_ns - slam.times_ns[0]) / 1e9
        lost = time_s[slam.lost]
        spread = {"root mean square distance": _position_std_mm(run)}
        pictures["reported standard deviation of the camera's position; lost frames in red"] = charts.lines(
            time_s, spread, "time, s", "mm", marked=lost
        )
        pictures["share of the returns that lie on the map"] = charts.lines(
            time_s, {"explained": slam.explained}, "time, s", "share", marked=lost
        )
    if pictures:
        page.section("Camera")
        page.pictures(pictures)
    if room is not None:
        page.pictures(_views(run))


def _views(run: ReportedRun) -> dict[str, bytes]:
    """A few of the images that the run kept."""
    room = run.values.room
    assert room is not None
    chosen = np.unique(np.linspace(0, len(room.frames) - 1, VIEWS).round().astype(int))
    found = {}
    for view in map(int, chosen):
        depth = depth_pixels(room.depth_mm[view] / 1000)
        both = depth if room.view_rgb is None else np.concatenate([room.view_rgb[view], depth], axis=1)
        found[f"frame {room.frames[view]}"] = png(both)
    return found


def _shapes(page: Page, run: ReportedRun) -> None:
    if not run.values.shapes:
        return
    page.section("Learned shapes")
    folder = RunFolder(run.path, force=False)
    models = [learned_model(folder.value_path(f"learn/{name}")) for name in run.values.shapes]
    page.pictures({model.name: shape_picture(model.in_frame("base")) for model in models})
    page.table(
        ["shape", "pitch", "voxels seen occupied", "inferred behind", "seen free", "volume"],
        [
            [
                model.name,
                f"{1000 * run.summary['learn'][model.name]['pitch_m']:g} mm",
                *(
                    str(run.summary["learn"][model.name][key])
                    for key in ("seen_occupied", "enclosed", "seen_free")
                ),
                f"{1e6 * model.mesh.volume:.0f} cm3",
            ]
            for model in models
        ],
    )


def _objects(page: Page, run: ReportedRun) -> None:
    parse = run.summary.get("parse")
    if parse is None:
        return
    page.section("Objects")
    picture = scene_picture(run.values)
    if picture:
        page.pictures({f"frame {parse['frames'][0]} with the objects found": picture})
    rests = {edge["child"]: edge for edge in sorted(parse["graph"], key=lambda one: one["probability"])}
    rows = []
    for one in parse["objects"]:
        place = ", ".join(f"{100 * metres:.1f}" for metres in one["middle_m"])
        share = max((mode["probability"] for mode in one["modes"]), default=1.0)
        edge = rests.get(one["name"])
        support = f"{edge['parent']} ({edge['probability']:.0%})" if edge else "nothing"
        spread = ", ".join((position_text(one), rotation_text(one), agreement_text(one))).removesuffix(", ")
        presence, visible = presence_text(one), f"{one['visible_fraction']:.0%}"
        rows.append([one["name"], presence, f"({place}) cm", spread, f"{share:.0%}", visible, support])
    header = [
        "object",
        "presence",
        "centre",
        "standard deviation, all samples",
        "share of its mode",
        "visible",
    ]
    page.table([*header, "rests on"], rows)
    if parse["not_found"]:
        told = ", ".join(f"{one['name']} ({presence_text(one)})" for one in parse["not_found"])
        page.text(f"Not found, with the probability that it is there all the same: {told}.", soft=True)


def _settings(page: Page, run: ReportedRun) -> None:
    settings = run.path / "config.toml"
    if settings.is_file():
        page.section("Settings")
        page.listing(settings.read_text(encoding="utf-8"))


def _position_std_mm(run: ReportedRun) -> np.ndarray:
    slam = run.values.slam
    assert slam is not None
    return 1000 * np.sqrt(np.trace(slam.covariance[:, :3, :3], axis1=1, axis2=2))
