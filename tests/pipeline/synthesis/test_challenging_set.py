"""A set on disk: read by a reader of its own, the same bytes however it was made."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.errors import PipelineError
from pipeline.executors import executors_for
from pipeline.mesh_source import MeshSource
from pipeline.synthesis.challenging_scene import ChallengingScene
from pipeline.synthesis.challenging_set import ChallengingSet, write_set
from pipeline.synthesis.scenarios import CameraConfig
from recordings.importers.bop import read_bop
from recordings.importers.dataset import write_dataset
from recordings.options import ReadOptions
from recordings.reading import open_recording
from recordings.truth import recorded_scene_truth
from tests.pipeline.synthesis.z_buffer import z_buffer

WANTED = ChallengingSet(
    kinds=("single", "occluded"),
    images=2,
    scene=ChallengingScene(camera=CameraConfig(width=160, height=120)),
    shapes=MeshSource(names=("box", "can", "bracket")),
    seed=3,
)


def written(wanted: ChallengingSet, out: Path, workers: int = 1, *, force: bool = False) -> Path:
    """The set in a folder."""
    executors, at_once = executors_for(workers)
    write_set(wanted, out, executors, at_once, lambda *_: None, force=force)
    return out


def contents(folder: Path) -> dict[str, bytes]:
    """Bytes of every file by its path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two kinds of two images."""
    return written(WANTED, tmp_path_factory.mktemp("sets") / "set")


def test_bop_files_and_recordings_say_the_same(folder: Path) -> None:
    """Depth, poses, ids and visible fractions, read from the format's description alone."""
    for scene in sorted((folder / "test").iterdir()):
        cameras, truths, infos = (
            json.loads((scene / f"scene_{name}.json").read_text()) for name in ("camera", "gt", "gt_info")
        )
        assert sorted(map(int, cameras)) == [0, 1]
        for key, camera in cameras.items():
            name = f"{int(key):06d}"
            kind = {"000001": "single", "000004": "occluded"}[scene.name]
            path = folder / "recordings" / kind / f"{name}.mcap"
            (frame,) = list(open_recording(path, ReadOptions()))
            stored = np.array(Image.open(scene / "depth" / f"{name}.png"), np.uint16)
            np.testing.assert_array_equal(
                (stored * camera["depth_scale"] / 1000).astype(np.float32), frame.depth_m
            )
            np.testing.assert_array_equal(np.array(Image.open(scene / "rgb" / f"{name}.png")), frame.rgb)
            truth = recorded_scene_truth(path)
            assert truth is not None
            world = np.eye(4)
            world[:3, :3] = np.reshape(camera["cam_R_w2c"], (3, 3))
            world[:3, 3] = np.array(camera["cam_t_w2c"]) / 1000
            for index, (one, gt, info) in enumerate(zip(truth.objects, truths[key], infos[key], strict=True)):
                assert gt["obj_id"] == WANTED.shapes.ids[one.shape]
                pose = np.eye(4)
                pose[:3, :3] = np.reshape(gt["cam_R_m2c"], (3, 3))
                pose[:3, 3] = np.array(gt["cam_t_m2c"]) / 1000
                np.testing.assert_allclose(pose, world @ one.world_from_object, atol=1e-9)
                masks = [
                    np.array(Image.open(scene / part / f"{name}_{index:06d}.png")) > 0
                    for part in ("mask", "mask_visib")
                ]
                assert (masks[0] | ~masks[1]).all()
                assert masks[1].sum() == info["px_count_visib"]
                assert info["visib_fract"] == pytest.approx(one.visible_fraction)


def test_masks_are_what_is_nearest_and_depth_lies_within_the_noise(folder: Path) -> None:
    """Against a z-buffer: masks within their borders, 98% of the measured depths within 4 sigma.

    The sensor's outliers take one in a hundred, and borders of few pixels some more.
    """
    meshes = WANTED.shapes.meshes
    names = {number: name for name, number in WANTED.shapes.ids.items()}
    scene = folder / "test" / "000004"
    cameras, truths = (json.loads((scene / f"scene_{name}.json").read_text()) for name in ("camera", "gt"))
    intrinsics = WANTED.scene.camera.intrinsics
    for key in cameras:
        posed = []
        for gt in truths[key]:
            pose = np.eye(4)
            pose[:3, :3] = np.reshape(gt["cam_R_m2c"], (3, 3))
            pose[:3, 3] = np.array(gt["cam_t_m2c"]) / 1000
            posed.append((meshes[names[gt["obj_id"]]], pose))
        depth, owner = z_buffer(posed, intrinsics)
        stored = np.array(Image.open(scene / "depth" / f"{int(key):06d}.png")) / 10_000
        for index in range(len(posed)):
            mask = np.array(Image.open(scene / "mask_visib" / f"{int(key):06d}_{index:06d}.png")) > 0
            assert (mask & (owner == index)).sum() >= 0.9 * max(mask.sum(), (owner == index).sum())
            seen = mask & (owner == index) & (stored > 0)
            sigma = 0.0012 + 0.0019 * (depth[seen] - 0.4) ** 2
            assert (np.abs(stored[seen] - depth[seen]) < 4 * sigma + 1e-4).mean() > 0.98 - 1 / seen.sum()


def test_targets_and_models_are_complete(folder: Path) -> None:
    """Every object of every image is a target, and every object has its model in millimetres."""
    targets = json.loads((folder / "test_targets_bop19.json").read_text())
    info = json.loads((folder / "models" / "models_info.json").read_text())
    assert len(targets) == 2 + 4
    assert {row["obj_id"] for row in targets} <= set(map(int, info))
    assert all((folder / "models" / f"obj_{int(number):06d}.ply").is_file() for number in info)
    assert info[str(WANTED.shapes.ids["box"])]["size_z"] == pytest.approx(210, abs=1e-6)


def test_an_imported_scene_is_the_recording(folder: Path, tmp_path: Path) -> None:
    """`import bop` of a scene's first image gives its depth and its objects where they stand."""
    out = tmp_path / "back.mcap"
    write_dataset(read_bop(folder / "test" / "000004", slice(0, 1)), out, lambda *_: None)
    recording = folder / "recordings" / "occluded" / "000000.mcap"
    (back,), (frame,) = (
        list(open_recording(out, ReadOptions())),
        list(open_recording(recording, ReadOptions())),
    )
    np.testing.assert_array_equal(back.depth_m, frame.depth_m)
    truth, first = recorded_scene_truth(out), recorded_scene_truth(recording)
    assert truth is not None
    assert first is not None
    ids = WANTED.shapes.ids
    assert [one.shape for one in truth.objects] == [f"obj_{ids[one.shape]:06d}" for one in first.objects]
    for one, other in zip(truth.objects, first.objects, strict=True):
        np.testing.assert_allclose(one.world_from_object, other.world_from_object, atol=1e-9)


def test_an_interrupted_set_goes_on_to_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    """Without some images, or beginning with fewer; other settings are refused unless forced."""
    part = written(replace(WANTED, images=1), tmp_path / "part")
    assert contents(written(WANTED, part)) == contents(folder)
    (part / "test" / "000004" / "entries" / "000001.json").unlink()
    (part / "test" / "000004" / "depth" / "000001.png").write_bytes(b"cut")
    assert contents(written(WANTED, part)) == contents(folder)
    with pytest.raises(PipelineError, match="--force"):
        written(replace(WANTED, seed=4), part)
    assert contents(part) == contents(folder)
    assert contents(written(replace(WANTED, seed=4), part, force=True)) != contents(folder)


@pytest.mark.slow
def test_workers_write_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    """Two spawned processes."""
    assert contents(written(WANTED, tmp_path / "two", workers=2)) == contents(folder)


@pytest.mark.slow
def test_kills_change_no_byte(folder: Path, tmp_path: Path, seed: int) -> None:
    """The command with two workers is killed twenty times at random moments, then ends in the same bytes."""
    words = [sys.executable, "-m", "pipeline", "synth", "challenging", str(tmp_path / "killed"), "--quiet"]
    words += ["--images", "2", "--kinds", "single,occluded", "--only", "box,can,bracket", "--size", "160x120"]
    words += ["--seed", "3", "--workers", "2"]
    rng = np.random.default_rng(seed)
    for _ in range(20):
        process = subprocess.Popen(words)
        try:
            process.wait(timeout=rng.uniform(1.0, 12.0))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    subprocess.run(words, check=True)
    assert contents(tmp_path / "killed") == contents(folder)
