"""Whatever a stage can commit is published: numbers that are not finite, one frame, all frames lost."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.publishing.publish import publish
from pipeline.publishing.values import RunValues
from pipeline.run_access import open_run_folder
from pipeline.run_folder import RunFolder
from scene.result import SceneResult
from shapes.prior import ShapePrior
from slam.result import SlamResult

DERIVED = ("config.toml", "summary.json", "timing.json", "run.mcap", "run.rrd")


def published(run: Path, values: RunValues) -> dict:
    """summary.json of a run that committed these values."""

    def commit(folder: RunFolder, name: str, value: object) -> None:
        kind = type(value)
        settings = {"run": {"seed": 0}}
        folder.stage(name, kind.load, lambda: value, settings=settings, inputs={})  # type: ignore[attr-defined]

    with open_run_folder(run, {"r.mcap": "a"}) as folder:
        for name, value in (("slam", values.slam), ("objects", values.surfaces), ("parse", values.scene)):
            if value is not None:
                commit(folder, name, value)
        for name, shape in values.shapes.items():
            commit(folder, f"learn/{name}", shape)
        publish(folder)
    assert all((run / name).stat().st_size > 0 for name in DERIVED)
    return json.loads((run / "summary.json").read_text())


def disturbed(value, rng: np.random.Generator, number: float):
    """The same with some of its floating-point numbers replaced, in one to three of its arrays."""
    names = [f.name for f in fields(value) if getattr(value, f.name).dtype.kind == "f"]
    chosen = rng.choice(names, rng.integers(1, 4), replace=False)
    changed = {}
    for name in chosen:
        array = np.array(getattr(value, name), copy=True)
        largest = float(np.finfo(array.dtype).max)
        told = np.clip(number, -largest, largest) if np.isfinite(number) else number
        array[rng.random(array.shape) < rng.choice([0.05, 0.5, 1.0])] = told
        changed[name] = array
    return replace(value, **changed)


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf, 1e300, -1e300])
def test_any_path_and_scene_is_published(
    parsed_run: RunValues, tmp_path: Path, seed: int, number: float
) -> None:
    """Random arrays of a path and of a scene hold numbers that mean nothing."""
    rng = np.random.default_rng(seed)
    assert parsed_run.slam is not None
    assert parsed_run.scene is not None
    for trial in range(4):
        values = replace(
            parsed_run,
            slam=disturbed(parsed_run.slam, rng, number),
            scene=disturbed(parsed_run.scene, rng, number),
        )
        assert {"slam", "parse"} <= set(published(tmp_path / str(trial), values))


def test_evidence_of_minus_infinity_is_null_with_a_sentence(
    true_trajectory: SlamResult, tmp_path: Path
) -> None:
    """As of depths that the model gives no density to."""
    evidence = np.array([-np.inf, *true_trajectory.log_evidence[1:]])
    summary = published(
        tmp_path, RunValues(slam=replace(true_trajectory, log_evidence=evidence), room=None, shapes={})
    )

    assert summary["slam"]["log_evidence"] is None
    assert summary["slam"]["warnings"] == ["log_evidence is -inf, told as null"]


def some_frames(result: SlamResult, chosen: slice) -> SlamResult:
    """The path of some of its frames."""
    per_frame = (
        "times_ns",
        "mean",
        "covariance",
        "hypotheses",
        "log_evidence",
        "resampled",
        "lost",
        "explained",
    )
    changed = {name: getattr(result, name)[chosen] for name in per_frame}
    return replace(result, draws=result.draws[:, chosen], **changed)


def test_one_frame_is_published(true_trajectory: SlamResult, tmp_path: Path) -> None:
    """With a path of one pose."""
    published(tmp_path, RunValues(slam=some_frames(true_trajectory, slice(1)), room=None, shapes={}))

    assert len((tmp_path / "trajectory.tum").read_text().splitlines()) == 1


def test_all_frames_lost_is_published_and_told(true_trajectory: SlamResult, tmp_path: Path) -> None:
    """Every frame with its stamp, in summary.json and lost.txt; no pose is told."""
    lost = replace(true_trajectory, lost=np.ones(len(true_trajectory), bool))
    summary = published(tmp_path, RunValues(slam=lost, room=None, shapes={}))

    assert [one["frame"] for one in summary["slam"]["lost"]] == list(range(6))
    assert len((tmp_path / "lost.txt").read_text().splitlines()) == 6
    assert (tmp_path / "trajectory.tum").read_text() == ""
    assert set((tmp_path / "trajectory.kitti").read_text().split()) == {"nan"}


@pytest.mark.parametrize("phi", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("mask", ["seen_free", "seen_occupied", "enclosed"])
def test_any_shape_is_published(small_shape: ShapePrior, tmp_path: Path, phi: float, mask: str) -> None:
    """Nothing solid, everything enclosed, nothing above one half."""
    masks = {
        name: np.zeros_like(small_shape.seen_free) for name in ("seen_free", "seen_occupied", "enclosed")
    }
    masks[mask][:] = True
    shape = replace(small_shape, phi=np.full_like(small_shape.phi, phi), **masks)
    summary = published(tmp_path, RunValues(slam=None, room=None, shapes={"mug": shape}))

    assert "mug" in summary["learn"]


def test_a_scene_in_which_nothing_was_found_is_published(parsed_run: RunValues, tmp_path: Path) -> None:
    """An empty list of objects."""
    assert parsed_run.scene is not None
    scene: SceneResult = replace(parsed_run.scene, presence=np.zeros(3))

    assert published(tmp_path, replace(parsed_run, scene=scene))["parse"]["objects"] == []
