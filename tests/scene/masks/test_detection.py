"""Detectors: shapes alone in an empty grid, the file that keeps them, shapes and frames without any."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from pipeline.mesh_source import MeshSource
from pipeline.synthesis.objects import built_in_object
from scene.masks import proposal
from scene.masks import shape_masks as masks_source
from scene.masks.grid import FREE, PITCH_M, STEPS, EvidenceGrid, SeenSpace
from scene.masks.proposal import Atoms, MaskSearch, best_atoms
from scene.masks.shape_masks import OUTSIDE, SURFACE, Detector, ShapeMasks, detector, is_thin
from scene.objects.scene_object import SceneObject, scene_object
from shapes import array_cache
from shapes.geometry.poses import matrices_of

QUICK_POSES, SLOW_POSES = 6, 96
"""Of a shape; 21 times 96 are 2,016."""
CELLS = 64


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of its own."""
    monkeypatch.setattr(array_cache, "user_cache_path", lambda *_, **__: tmp_path)
    return tmp_path / "masks"


def object_of(mesh: trimesh.Trimesh) -> SceneObject:
    """To be looked for."""
    return scene_object("it", np.asarray(mesh.vertices), np.asarray(mesh.faces))


@pytest.fixture(scope="module")
def bottle() -> SceneObject:
    """A built-in object, symmetric under a half turn."""
    return object_of(built_in_object("bottle"))


def alone(points_m: np.ndarray, rotation: np.ndarray, cell: np.ndarray) -> EvidenceGrid:
    """A grid that is free but for the surface of one object, its centre in the middle of a cell."""
    evidence = np.full((CELLS,) * 3, -FREE, np.int8)
    evidence[tuple((np.rint(points_m @ rotation.T / PITCH_M).astype(int) + cell).T)] = STEPS
    return EvidenceGrid(evidence=evidence, pitch_m=PITCH_M, camera_from_grid=np.eye(4))


def share_found(one: SceneObject, mesh: trimesh.Trimesh, poses: int, seed: int) -> float:
    """Share of random orientations and cells whose strongest atom has the surface where it is."""
    rng = np.random.default_rng(seed)
    masks = detector(one, PITCH_M, standing=True)
    drawn_m = np.asarray(trimesh.sample.sample_surface(mesh, 20_000, seed=0)[0])
    points_m = drawn_m @ one.box_from_object[:3, :3].T + one.box_from_object[:3, 3]
    found = 0
    for _ in range(poses):
        rotation = masks.fine.rotations[rng.integers(len(masks.fine.rotations))].astype(float)
        cell = rng.integers(24, 40, 3)
        atom = matrices_of(best_atoms(alone(points_m, rotation, cell), masks).poses[0])
        true_m = points_m[:2000] @ rotation.T + (cell + 0.5) * PITCH_M
        placed_m = points_m @ atom[:3, :3].T + atom[:3, 3]
        found += bool(KDTree(placed_m).query(true_m)[0].mean() < PITCH_M / 2)
    return found / poses


def test_alone_in_an_empty_grid_a_shape_is_found(bottle: SceneObject, seed: int) -> None:
    """At its cell and orientation, up to its symmetries: all of a few poses (a slow test has 2,016)."""
    assert share_found(bottle, built_in_object("bottle"), QUICK_POSES, seed) == 1


@pytest.mark.slow
def test_21_shapes_are_found_in_two_thousand_poses(shared_data: Path, seed: int) -> None:
    """In 99% of them."""
    shapes = MeshSource.of(shared_data / "ycbv" / "models", None)
    shares = {
        name: share_found(object_of(mesh), mesh, SLOW_POSES, seed) for name, mesh in shapes.meshes.items()
    }
    print({name: round(share, 3) for name, share in shares.items()})
    assert np.mean(list(shares.values())) >= 0.99


def test_surface_cells_hold_surface_and_outer_ones_none(bottle: SceneObject) -> None:
    """By the distance of their middles from the shape's points."""
    masks = detector(bottle, PITCH_M, standing=True).fine
    tree = KDTree(trimesh.sample.sample_surface(built_in_object("bottle"), 50_000, seed=0)[0])
    for turn in (0, 100, 415):
        cells, weights = masks.offsets[turn].astype(float), masks.weights[turn]
        distance, _ = tree.query(cells @ masks.rotations[turn] * PITCH_M)
        assert distance[weights == SURFACE].max() < 0.9 * PITCH_M  # half the diagonal of a cell
        assert distance[weights == OUTSIDE].min() > 1.3 * PITCH_M
        assert min((weights == SURFACE).sum(), (weights == OUTSIDE).sum()) > 20


def test_a_grid_without_a_surface_has_no_atoms(bottle: SceneObject) -> None:
    """Nothing but free space, or nothing seen at all; a single cell of surface has some."""
    masks = detector(bottle, PITCH_M, standing=True)
    evidence = np.zeros((24, 24, 24), np.int8)
    counts = []
    for value, lit in ((0, 0), (-FREE, 0), (0, STEPS)):
        evidence[:] = value
        evidence[12, 12, 12] = lit or value
        grid = EvidenceGrid(evidence=evidence, pitch_m=PITCH_M, camera_from_grid=np.eye(4))
        counts.append(len(best_atoms(grid, masks).poses))

    assert counts[:2] == [0, 0]
    assert counts[2] > 0


def same(first: Detector, second: Detector) -> bool:
    """Whether two have the same masks."""

    def equal(one: ShapeMasks, other: ShapeMasks) -> bool:
        return bool((one.offsets == other.offsets).all() and (one.weights == other.weights).all())

    return equal(first.coarse, second.coarse) and equal(first.fine, second.fine)


def test_a_detector_is_kept_and_read(
    bottle: SceneObject, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second time nothing is made; other pitches and axes have files of their own."""
    made = detector(bottle, PITCH_M, standing=True)
    (path,) = cache.iterdir()
    with monkeypatch.context() as patch:
        patch.setattr(masks_source, "shape_masks", None)
        assert same(detector(bottle, PITCH_M, standing=True), made)
        with pytest.raises(TypeError):
            detector(bottle, PITCH_M, standing=False)
    assert path.stat().st_size < 500_000


def test_a_damaged_file_is_made_anew(bottle: SceneObject, cache: Path) -> None:
    """Cut off, of other arrays, or empty: the same masks come back, and the file is whole again."""
    made = detector(bottle, PITCH_M, standing=True)
    (path,) = cache.iterdir()
    whole = path.read_bytes()
    others = io.BytesIO()
    np.savez(others, coarse_offsets=np.zeros(3))
    for damaged in (whole[: len(whole) // 2], others.getvalue(), b""):
        path.write_bytes(damaged)

        assert same(detector(bottle, PITCH_M, standing=True), made)
        assert path.read_bytes() == whole


def test_a_folder_that_cannot_be_written_costs_no_answer(bottle: SceneObject, cache: Path) -> None:
    """A file lies where the folder should be."""
    cache.write_bytes(b"")

    assert detector(bottle, PITCH_M, standing=True).fine.counts.min() > 0


def test_what_is_thinner_than_half_a_cell_is_left_to_others(bottle: SceneObject) -> None:
    """A card of a millimetre has no masks; two fifths of a cell are too thin, three are not."""
    card, slab = (
        replace(bottle, half_extents_m=np.array([0.04, 0.03, share * PITCH_M / 2])) for share in (0.4, 0.6)
    )

    assert is_thin(card, PITCH_M)
    assert not is_thin(slab, PITCH_M)
    nothing = MaskSearch(seen=None, detectors=[None])

    assert nothing.atoms(0, np.ones((2, 2), bool)).poses.shape == (0, 7)


def test_masks_are_laid_again_only_on_other_pixels(
    bottle: SceneObject, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A twentieth of the pixels more or fewer are the same, half of them are not."""
    sought: list[int] = []

    def counted(grid: EvidenceGrid, shape: Detector) -> Atoms:  # noqa: ARG001
        sought.append(int((grid.evidence > 0).sum()))
        return Atoms.none()

    monkeypatch.setattr(proposal, "best_atoms", counted)
    cells = np.stack([*np.indices((20, 20)), np.zeros((20, 20), int)], axis=-1)
    seen = SeenSpace(
        free=np.ones((20, 20, 2), bool), cells=cells, pitch_m=PITCH_M, camera_from_grid=np.eye(4)
    )
    search = MaskSearch(seen=seen, detectors=[detector(bottle, PITCH_M, standing=True)] * 2)
    masks = [np.arange(400).reshape(20, 20) < count for count in (200, 190, 210, 400, 390, 0, 0)]
    for mask in masks:
        search.atoms(0, mask)
    search.atoms(1, masks[0])

    assert sought == [200, 400, 0, 200]
