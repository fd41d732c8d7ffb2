"""`voxscene eval poses`: a parsed scene against the true poses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pipeline.errors import PipelineError
from pipeline.options import AnyPath, Common, common_options

if TYPE_CHECKING:
    import trimesh

    from pipeline.surfaces import Surfaces
    from recordings.truth import TrueObject

SAME_SIZE = 0.01
"""Relative difference in size above which a surface is not the true one."""


@click.command(name="poses")
@click.argument("run", type=AnyPath())
@click.option("--truth", type=AnyPath(), required=True, metavar="REC", help="Holds the truth.")
@common_options(computes=True)
def command(common: Common, run: Path, truth: Path) -> None:
    """ADD-S of each object in RUN.

    RUN was parsed with the objects' own meshes. ADD-S is the mean distance from points of the object at its
    true pose to its surface at the pose found. Objects of the truth that RUN did not look for are named and
    left out; so are false finds. One that RUN looked for and did not find is missing, also where no image
    shows it.
    """
    from pipeline.evaluation.same_recording import check_truth, truth_options
    from pipeline.evaluation.scenes import object_errors, parents_right, summary_of_errors
    from pipeline.evaluation.truth import RecordedTruth
    from pipeline.publishing.values import RunValues
    from pipeline.run_folder import RunFolder, check_one_recording

    check_one_recording(run)
    folder = RunFolder(run)
    values = RunValues.load(folder)
    scene = values.scene
    if scene is None or values.surfaces is None:
        raise PipelineError(f"{run} holds no finished parse; make it with: voxscene parse REC -o {run}")
    known = RecordedTruth(truth, truth_options(folder, "parse"))
    objects = [one for one in known.scene.objects if one.shape in values.surfaces.by_name]
    left_out = [one.name for one in known.scene.objects if one.shape not in values.surfaces.by_name]
    if not objects:
        raise PipelineError(f"{run} looked for none of the objects of {truth}: {', '.join(left_out)}")
    check_truth(folder, truth)
    shapes, shape_of = {one.shape for one in objects}, _shapes(values.surfaces)
    found = [(name if name in shapes else shape_of[name], pose) for name, pose in scene.found_poses]
    errors = object_errors(
        objects,
        {one.shape: _mesh(one, values.surfaces) for one in objects},
        known.camera_from_world(values.parsed_time_ns),
        found,
    )
    document = summary_of_errors(errors, parents_right(scene, objects)) | {
        "not_looked_for": left_out,
        "not_there": [name for name, _ in found if name not in shapes],
    }
    common.report(document, _lines(document))


def _shapes(surfaces: Surfaces) -> dict[str, str]:
    """The shape of each name that was looked for: that of a copy is the first one's."""
    from scene.copies import copies_among

    names = list(surfaces.by_name)
    alike = copies_among({name: one.vertices_m for name, one in surfaces.by_name.items()})
    return dict(zip(names, [names[first] for first in alike.argmax(axis=1)], strict=True))


def _mesh(one: TrueObject, surfaces: Surfaces) -> trimesh.Trimesh:
    """The object's true surface, from the truth or, where it brings none, from the run."""
    import trimesh

    from pipeline.evaluation.truth import true_mesh

    kept = surfaces.by_name[one.shape]
    looked_for = trimesh.Trimesh(kept.vertices_m, kept.faces, process=False)
    if one.vertices_m is None:
        return looked_for
    true = true_mesh(one)
    if abs(true.bounds - looked_for.bounds).max() > SAME_SIZE * true.scale:
        raise PipelineError(f"{one.shape} was not parsed with its own mesh: a learned frame has no true pose")
    return true


def _lines(document: dict[str, Any]) -> list[str]:
    from pipeline.evaluation.object_poses import MISSING_M

    lines = [f"{'object':<24} {'ADD-S mm':>9} {'visible':>8} {'parent':>7}"]
    for one in document["objects"]:
        error = f"{1000 * one['add_s_m']:.1f}" if one["found"] else "missing"
        visible = "" if one["visible_fraction"] is None else f"{one['visible_fraction']:.2f}"
        parent = {None: "", True: "right", False: "wrong"}[one["parent_right"]]
        lines.append(f"{one['name']:<24} {error:>9} {visible:>8} {parent:>7}")
    shares = ", ".join(
        f"{share:.0%} under {1000 * float(level):g} mm" for level, share in document["accuracy"].items()
    )
    found = [one["add_s_m"] for one in document["objects"] if one["found"]]
    missing = len(document["objects"]) - len(found)
    largest = f"largest {1000 * max(found):.1f} mm" if found else "none found"
    largest += f", {missing} missing, in the median as {MISSING_M:g} m" if missing else ""
    if document["not_looked_for"]:
        lines.append(f"not looked for, and left out: {', '.join(document['not_looked_for'])}")
    if document["not_there"]:
        lines.append(f"found, but not there: {', '.join(document['not_there'])}")
    lines.append(f"median {1000 * document['median_m']:.1f} mm, {largest}; {shares}")
    return lines
