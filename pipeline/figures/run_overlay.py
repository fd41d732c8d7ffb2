"""What a run's parse found, outlined on the image that it was found in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from pipeline.errors import PipelineError
from pipeline.evaluation.same_recording import check_truth, truth_options
from pipeline.evaluation.truth import RecordedTruth, true_mesh
from pipeline.export.files import write_contents
from pipeline.export.run_room import open_parsed
from pipeline.figures.canvas import figure_bytes, panels
from pipeline.figures.overlays import Outline, draw_overlay
from pipeline.publishing.values import RunValues
from pipeline.run_folder import RunFolder
from recordings.options import ReadOptions
from recordings.reading import McapRecording
from recordings.types import Frame

FOUND, TRUE = "tab:green", "white"
INCHES = 6.4
FILES = ("overlay.png", "overlay.svg")


def export_overlay(
    run: Path, out: Path, recording: Path | None, truth: Path | None, *, force: bool = False
) -> list[Path]:
    """Write overlay.png and overlay.svg.

    Args:
        run: run folder with a finished parse.
        out: folder.
        recording: that the run was made from; None looks for it near the run.
        truth: recording that holds the true poses, outlined in white; None leaves them out.
        force: replace pictures that differ.

    Raises:
        PipelineError: the run has no parse, its recording is not found, the truth is that of another one, or
            a picture is there and differs.
    """
    folder = RunFolder(run)
    values = RunValues.load(folder)
    scene = values.scene
    if scene is None or values.surfaces is None:
        raise PipelineError(f"{run} holds no finished parse; make it with: voxscene parse REC -o {run}")
    film = open_parsed(run, recording)
    frame = _frame(film, int(scene.frames[0]))
    outlines = _true_outlines(truth, truth_options(folder, "parse"), frame) if truth else []
    if truth:
        check_truth(folder, truth)
    captions = []
    for one in np.flatnonzero(scene.found):
        name = str(scene.names[one])
        surface = values.surfaces.by_name[name]
        outlines.append(
            Outline(
                mesh=trimesh.Trimesh(surface.vertices_m, surface.faces, process=False),
                camera_from_mesh=scene.camera_from_object[one],
                colour=FOUND,
                label="found",
            )
        )
        captions.append(f"{name} {scene.presence[one]:.2f}")
    figure, axes = panels(1, 1, INCHES, INCHES * film.intrinsics.height / film.intrinsics.width + 0.5)
    draw_overlay(axes[0][0], frame, film.intrinsics, outlines, crop=False)
    axes[0][0].set_title("presence: " + (", ".join(captions) or "nothing was found"), fontsize=7)
    return write_contents(out, {name: figure_bytes(figure, Path(name).suffix) for name in FILES}, force=force)


def _frame(film: McapRecording, number: int) -> Frame:
    for index, frame in enumerate(film):
        if index == number:
            return frame
    raise PipelineError(
        f"the recording has no depth frame {number}, which was parsed; name it with --recording"
    )


def _true_outlines(truth: Path, options: ReadOptions, frame: Frame) -> list[Outline]:
    known = RecordedTruth(truth, options)
    camera_from_world = known.camera_from_world(frame.time_ns)
    return [
        Outline(
            mesh=true_mesh(one),
            camera_from_mesh=camera_from_world @ one.world_from_object,
            colour=TRUE,
            label="truth",
        )
        for one in known.scene.objects
        if one.vertices_m is not None
    ]
