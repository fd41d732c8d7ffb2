"""`export RUN --mesh` finds the recording that the run was made from, and no other."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

from pipeline.cli import voxscene
from pipeline.fingerprints import file_hash
from pipeline.run_access import open_run_folder
from slam.result import SlamResult


@pytest.fixture
def run(mug_file: Path, true_trajectory: SlamResult, tmp_path: Path) -> Path:
    """A finished slam beside its recording."""
    recording = tmp_path / "mug.mcap"
    shutil.copyfile(mug_file, recording)
    with open_run_folder(tmp_path / "mug.run", {recording.name: file_hash(recording)}) as folder:
        folder.stage("slam", SlamResult.load, lambda: true_trajectory, settings={}, inputs={})
    return tmp_path / "mug.run"


def export(run: Path, *arguments: str):
    """The command on a run, with triangles of three centimetres."""
    command = ["export", str(run), "--mesh", "--pitch", "0.03", "--format", "ply", "--quiet", *arguments]
    return CliRunner().invoke(voxscene, command)


def test_the_room_is_fused_from_the_runs_own_recording(run: Path, filmed_mug, tmp_path: Path) -> None:
    """Half of its vertices lie within a centimetre of the true surfaces, and they have colours."""
    result = export(run, "-o", str(tmp_path / "out"))
    assert result.exit_code == 0, result.output
    mesh = trimesh.load_mesh(tmp_path / "out" / "room.ply")
    world = trimesh.transform_points(mesh.vertices, filmed_mug.trajectory.reference_from_camera[0])
    assert len(mesh.faces) > 1000
    assert np.median(filmed_mug.clearance_m(world)) < 0.01
    visual: Any = mesh.visual
    assert visual.kind == "vertex"


def test_another_recording_of_that_name_is_not_taken(run: Path, tmp_path: Path) -> None:
    """Changed or gone: one line that says what to do."""
    (tmp_path / "mug.mcap").write_bytes(b"another")
    result = export(run, "-o", str(tmp_path / "out"))
    assert result.exit_code == 1
    assert "give --recording" in result.stderr or "name it with --recording" in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_room_that_no_format_holds_is_refused(run: Path, tmp_path: Path) -> None:
    """One line that names the formats, before anything is fused."""
    result = export(run, "--format", "obj", "-o", str(tmp_path / "out"))
    assert result.exit_code == 2
    assert "ply or glb" in result.stderr
    assert not (tmp_path / "out").exists()
