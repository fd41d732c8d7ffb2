"""`synth air` writes what `bench air` searches, and the bench judges what it finds."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from pipeline.benchmarks.air import AirRow, figures
from pipeline.cli import voxscene
from pipeline.synthesis.air import air_meshes, air_scene, air_world
from recordings.reading import open_recording
from recordings.truth import recorded_scene_truth
from scene.colour.posterior import overlapping


def test_files_hold_the_scenes_of_the_bench(tmp_path: Path) -> None:
    """Colour in 8 bits, no depth at all, the truth on its topic; a folder with files is left alone."""
    arguments = ["synth", "air", str(tmp_path / "air"), "--scenes", "2", "--seed", "5", "--json"]
    result = CliRunner().invoke(voxscene, arguments)
    assert result.exit_code == 0, result.output
    written = json.loads(result.stdout)
    world, meshes = air_world(), air_meshes()
    for seed, one in enumerate(written, start=5):
        scene = air_scene(world, seed)
        truth = recorded_scene_truth(Path(one["path"]))
        assert truth is not None
        assert [thing.shape for thing in truth.objects] == one["things"]
        assert one["things"] == [world.kinds[kind].name for kind in scene.truth.kinds]
        for thing in truth.objects:  # `eval poses` asks for it in the frame of the meshes that are parsed
            assert thing.vertices_m is not None
            np.testing.assert_allclose(thing.vertices_m, meshes[thing.shape].vertices, atol=1e-6)
            standing = thing.vertices_m @ thing.world_from_object[:3, :3].T + thing.world_from_object[:3, 3]
            np.testing.assert_allclose(standing[:, 2].min(), 0.0, atol=1e-6)
        frame = next(iter(open_recording(Path(one["path"]))))
        assert not frame.depth_m.any()
        assert frame.rgb is not None
        np.testing.assert_allclose(frame.rgb / 255, np.clip(scene.image, 0, 1), atol=0.51 / 255)

    again = CliRunner().invoke(voxscene, arguments)
    assert again.exit_code == 1
    assert "is not empty" in again.stderr


def test_drawn_scenes_follow_the_prior() -> None:
    """Numbers uniform on 0..3 before the overlap rule, which none breaks; albedos are colours."""
    world = air_world(32, 32)
    scenes = [air_scene(world, seed) for seed in range(60)]
    counts = np.bincount([len(scene.truth) for scene in scenes], minlength=4)

    assert counts.min() >= 4  # of 60 by 1/4: fewer in one draw of 10^4
    assert not any(overlapping(world, scene.truth).any() for scene in scenes)
    assert all(((scene.albedo >= 0) & (scene.albedo <= 1)).all() for scene in scenes)


def test_the_bench_resumes_from_its_rows(tmp_path: Path) -> None:
    """Two scenes, then a third: rows that are there are not searched again."""
    path = tmp_path / "air.csv"
    arguments = ["bench", "air", "--size", "24x24", "--seed", "3", "--csv", str(path), "--json"]
    for scenes in ("1", "2"):
        result = CliRunner().invoke(voxscene, [*arguments, "--scenes", scenes])
        assert result.exit_code == 0, result.output
    with path.open(newline="") as file:
        assert [row["scene"] for row in csv.DictReader(file)] == ["3", "4"]
    assert json.loads(result.stdout)["scenes"] == 2

    whole = path.read_bytes()
    for other in (["--size", "32x24"], ["--lamp", "other"]):
        result = CliRunner().invoke(voxscene, [*arguments, *other, "--scenes", "1"])
        assert result.exit_code == 1
        assert "holds scene 3 of" in result.stderr
        assert result.stderr.count("\n") == 1
    assert path.read_bytes() == whole

    path.write_text("nothing\n1\n")
    result = CliRunner().invoke(voxscene, [*arguments, "--scenes", "1"])
    assert result.exit_code == 1
    assert "was not written by bench air" in result.stderr


def test_a_table_that_cannot_be_written_is_refused_before_any_search(tmp_path: Path) -> None:
    """No scene is searched for a path in a folder that is not there."""
    result = CliRunner().invoke(voxscene, ["bench", "air", "--csv", str(tmp_path / "no" / "air.csv")])
    assert result.exit_code == 1
    assert "there is no folder" in result.stderr


def row(true: str, found: str, gap: float = 0.0, visible: int = 50) -> AirRow:
    """Of a scene with these kinds."""
    return AirRow(
        scene=7,
        size="64x64",
        lamp="known",
        sources="",
        true_kinds=true,
        found_kinds=found,
        least_visible=visible,
        count_probability=0.9,
        told_probability=0.9,
        most_probable=len(found.split("+")) if found else 0,
        score_gap=gap,
        errors_m="0.001+0.003" if true == found else "",
        mug_yaw_errors_rad="",
        seconds=1.0,
        core_seconds=1.0,
    )


def test_figures_count_what_is_right() -> None:
    """Kinds are judged where the number is right; specks apart; what the search missed is listed."""
    rows = [row("ball+cube", "ball+cube"), row("ball+cube", "ball+mug"), row("ball", "", gap=-9, visible=3)]
    found = figures(rows)

    assert found["count_right"] == pytest.approx(2 / 3)
    assert found["count_right_all_seen"] == 1
    assert found["kinds_right_where_count_is"] == 0.5
    assert found["place_median_m"] == pytest.approx(0.002)
    assert found["missed_by_search"] == [7]
    assert found["count_ece"] == pytest.approx(abs(3 * 0.9 - 2) / 3)
