"""`bench shapes` on a box: what it measures, with what, and its peers on the same views."""

import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import trimesh

from pipeline.benchmarks import pose_methods, shape_films
from pipeline.benchmarks import shapes as bench
from pipeline.benchmarks.shape_summary import exponent, falls, summary
from pipeline.benchmarks.shapes import shape_rows
from pipeline.peers import REGISTRATIONS, VOXEL_MAPS, registration
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import CameraConfig
from shapes.learning.config import LearnConfig
from shapes.learning.distillation import learn_shape


@pytest.fixture(scope="module")
def learned_with() -> list:
    """Calls of the production function."""
    return []


CONFIG = replace(LearnConfig(), pitch_m=0.01)


@pytest.fixture(scope="module")
def films() -> dict[str, trimesh.Trimesh]:
    """A solid box, and one of thin walls."""
    return {
        "solid": trimesh.creation.box((0.1, 0.08, 0.06)),
        "thin": trimesh.creation.box((0.1, 0.08, 0.004)),
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where rows are kept."""
    return tmp_path_factory.mktemp("rows") / "kept"


@pytest.fixture(scope="module")
def document(learned_with: list, films: dict, folder: Path) -> dict:
    """Two boxes, one of thin walls, from four views at a pitch of 1 cm, beside two peers."""
    with pytest.MonkeyPatch.context() as patch:

        def spied(*arguments):
            learned_with.append(arguments[-1])
            return learn_shape(*arguments)

        patch.setattr(bench, "learn_shape", spied)
        patch.setattr(shape_films, "ROOM", RoomConfig(kind="bare"))
        patch.setattr(shape_films, "CAMERA", CameraConfig(width=200, height=150))
        rows = list(shape_rows(films, list(films), [4], ["true"], ["carving", "tsdf"], CONFIG, 0, folder))
        return summary(rows, [], CONFIG.pitch_m)


def test_it_calls_the_production_function(document: dict, learned_with: list) -> None:
    """With the configuration that it was given."""
    assert len(document["rows"]) == 2
    assert {config.pitch_m for config in learned_with} == {0.01}


def test_rows_say_what_is_thin_and_how_well_it_went(document: dict) -> None:
    """A solid box is found; its ceiling is not below what was reached by more than rounding."""
    rows = {row["object"]: row for row in document["rows"]}
    assert not rows["solid"]["thin"]
    assert rows["thin"]["thin"]
    assert rows["solid"]["solid"] > 0.85
    assert rows["solid"]["ceiling"] > 0.9
    assert rows["solid"]["touched"] > 0.7
    assert rows["solid"]["wall_mm"] is None
    assert {mean["walls"] for mean in document["means"]} == {"all", "thick", "thin"}


def test_peers_see_the_same_box(document: dict) -> None:
    """Each finds most of it, so that none is crippled by a wrong frame."""
    row = next(row for row in document["rows"] if row["object"] == "solid")
    for peer, settings in row["peers"].items():
        assert max(one["solid"] for one in settings.values()) > 0.6, peer


def test_a_slice_takes_rows_that_were_kept(document: dict, films: dict, folder: Path) -> None:
    """Nothing is learned again with the same settings, and the rows say the same."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "film_of", lambda *_, **__: pytest.fail("filmed again"))
        (row,) = shape_rows(films, ["thin"], [4], ["true"], ["carving", "tsdf"], CONFIG, 0, folder)
    assert row.figures == next(one for one in document["rows"] if one["object"] == "thin")
    assert row.scored["voxscene"].shape[0] == 2


@pytest.mark.usefixtures("document")
@pytest.mark.parametrize("other", ["seed", "conditions", "mesh", "film", "source", "torn"])
def test_rows_of_other_settings_are_not_taken(
    other: str, films: dict, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor those of another mesh of that name, another film, another program, or a file that is no row."""
    kept = shutil.copytree(folder, tmp_path / "kept")
    if other == "torn":
        (kept / "thin 4 true.npz").write_bytes(b"PK")
    if other == "mesh":
        films = films | {"thin": trimesh.creation.box((0.1, 0.09, 0.004))}
    if other == "film":
        films = films | {"before": films["solid"]}
    if other == "source":
        monkeypatch.setattr(bench, "source_hash", lambda *_, **__: "another")
    filmed = Mock(side_effect=InterruptedError)
    monkeypatch.setattr(bench, "film_of", filmed)
    seed, conditions = int(other == "seed"), "paper" if other == "conditions" else "rings"
    peers = ["carving", "tsdf"]
    with pytest.raises(InterruptedError):
        list(shape_rows(films, ["thin"], [4], ["true"], peers, CONFIG, seed, kept, conditions))


def test_every_peer_of_the_command_has_settings() -> None:
    """Commands name peers without importing them."""
    assert tuple(bench.PEERS) == VOXEL_MAPS
    assert tuple(registration.settings()) == REGISTRATIONS
    assert tuple(pose_methods.PEERS) == REGISTRATIONS


def test_every_slice_films_a_mesh_alike(films: dict) -> None:
    """The seed of a mesh does not hang on which others are asked for."""
    seeds: list[int] = []

    def seeing(_mesh: trimesh.Trimesh, _views: int, seed: int, *_: object, **__: object) -> None:
        seeds.append(seed)
        raise InterruptedError

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "film_of", seeing)
        for only in (["solid"], ["thin"], ["solid", "thin"]):
            with pytest.raises(InterruptedError):
                next(shape_rows(films, only, [4], ["true"], [], CONFIG, 0))
    assert seeds[0] == seeds[2] != seeds[1]


def test_calibration_is_pooled_over_objects(document: dict) -> None:
    """For every method, on the same voxels."""
    scores = document["calibration"]
    assert len({one["count"] for one in scores}) == 1
    assert next(one for one in scores if one["method"] == "voxscene")["ece"] < 0.2
    assert np.isfinite([one["brier"] for one in scores]).all()


def test_a_fall_with_more_views_is_told() -> None:
    """From the best of fewer views, beyond what is tolerated."""
    rows = [
        {"object": "cup", "poses": "true", "views": views, "solid": solid}
        for views, solid in ((20, 0.93), (5, 0.94), (10, 0.937))
    ]
    (fall,) = falls(rows)
    assert fall["views"] == 20
    assert fall["fall"] == pytest.approx(0.01)


def test_growth_is_the_power_of_the_size() -> None:
    """Of an exact power; of one size nothing is known."""
    sizes = [100.0, 200.0, 400.0]
    assert exponent(sizes, [3 * size**1.5 for size in sizes]) == pytest.approx(1.5)
    assert exponent([5, 5], [1.0, 2.0]) is None
