"""`bench shapes`: the supplement's Table 1, with calibration, the ceiling of the views, and peers."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.benchmarks.shape_ceiling import reached_voxels
from pipeline.benchmarks.shape_films import (
    Conditions,
    ObjectFilm,
    PosedFilm,
    film_of,
    with_slam,
    with_true_poses,
)
from pipeline.benchmarks.shape_row import KeptRows, ShapeRow
from pipeline.benchmarks.shape_walls import WALL_FIGURES, wall_figures
from pipeline.errors import PipelineError
from pipeline.evaluation.calibration import calibration
from pipeline.evaluation.shapes import intersection_over_union, shape_agreement, true_voxels
from pipeline.fingerprints import COMPUTES, source_hash
from pipeline.mesh_source import surface_hash
from pipeline.peers.voxel_maps import PosedViews, VoxelMap, octomap, open3d_tsdf, space_carving
from pipeline.synthesis.world import Part, RayCaster
from shapes.learning.config import LearnConfig
from shapes.learning.distillation import learn_shape
from shapes.prior import ShapePrior
from shapes.voxel_grid import VoxelGrid

Poses = Literal["true", "slam", "orbit"]
SUPPLEMENT_IOU: Mapping[str, float] = {
    "002_master_chef_can": 0.9544,
    "003_cracker_box": 0.9716,
    "004_sugar_box": 0.9484,
    "005_tomato_soup_can": 0.9433,
    "006_mustard_bottle": 0.9671,
    "007_tuna_fish_can": 0.9696,
    "008_pudding_box": 0.9617,
    "009_gelatin_box": 0.9451,
    "010_potted_meat_can": 0.9654,
    "011_banana": 0.9599,
    "019_pitcher_base": 0.9808,
    "021_bleach_cleanser": 0.9582,
    "024_bowl": 0.9694,
    "025_mug": 0.9621,
    "035_power_drill": 0.966,
    "036_wood_block": 0.9679,
    "037_scissors": 0.9505,
    "040_large_marker": 0.9767,
    "051_large_clamp": 0.9218,
    "052_extra_large_clamp": 0.9228,
    "061_foam_brick": 0.9405,
}
"""Table 1 of the supplement, from inferred poses; its pitch and interior rule are not stated."""
SEED = 51_000
"""Of the films; none of a test's."""
MARGINS = (0.0, 0.3, 0.6, 1.0)
PEERS: Mapping[str, Mapping[str, VoxelMap]] = {
    "carving": {f"margin {margin:g} pitches": space_carving(margin, 1) for margin in MARGINS},
    "votes": {
        f"margin {margin:g} pitches, {votes} views": space_carving(margin, votes)
        for margin in MARGINS
        for votes in (2, 3)
    },
    "octomap": {
        f"hit {hit:g}, miss {miss:g}, free {free:g}": octomap(hit, miss, free)
        for hit, miss, free in ((0.7, 0.4, 0.5), (0.7, 0.4, 0.2), (0.6, 0.45, 0.3))
    },
    "tsdf": {f"truncation {pitches:g} pitches": open3d_tsdf(pitches) for pitches in (2.0, 4.0)},
}
"""Every peer with the settings it may choose from: the best mean over the run's own objects is printed.
`carving` frees a voxel that one view sees past; `votes` is carving that asks several views to agree."""
OURS, LIKELIEST = "voxscene", "voxscene, likeliest particle alone"
SCORES = ("brier", "log_loss", "ece")
NEAR_VOXELS = 3.0
"""Calibration is scored so near to the true surface."""
WALL_SAMPLES = 2000
THIN_SHARE = 0.1
GROWTH_PITCHES_M = (0.01, 0.007, 0.005, 0.0035)
GROWTH_VIEWS = 10


def shape_rows(
    meshes: Mapping[str, trimesh.Trimesh],
    only: Sequence[str],
    views: Sequence[int],
    kinds: Sequence[Poses],
    peers: Sequence[str],
    config: LearnConfig,
    seed: int,
    folder: Path | None = None,
    conditions: Conditions = "rings",
    *,
    noise_free: bool = False,
) -> Iterator[ShapeRow]:
    """Learn meshes from every number of views, with every kind of poses.

    Args:
        meshes: all of a folder, so that a mesh is filmed alike in every slice of the table.
        only: names of those that are learned.
        views: numbers of them.
        kinds: of poses.
        peers: names in `PEERS`.
        config: of learning.
        seed: of the films.
        folder: rows found there are taken from it, and new ones are kept there.
        conditions: of the films.
        noise_free: they measure exactly.
    """
    films = {"conditions": conditions, "noise_free": noise_free}
    alike = {"config": asdict(config), "seed": seed, "peers": sorted(peers), **films, "source": _source()}
    for count in views:
        for number, (name, mesh) in enumerate(sorted(meshes.items())):
            if name not in only:
                continue
            kept = KeptRows(folder, alike | {"mesh": surface_hash(mesh), "film": number})
            film = None
            for kind in kinds:
                row = kept.find(f"{name} {count} {kind}")
                if row is None:
                    film = film or film_of(
                        mesh, count, SEED + 1000 * seed + number, conditions, noise_free=noise_free
                    )
                    about = {"object": name, "views": count, "poses": kind, **films}
                    row = _filmed_row(film, about, peers, config, seed)
                    kept.keep(f"{name} {count} {kind}", row)
                yield row


def _source() -> str:
    """Of all that decides a row."""
    return source_hash(__name__, within=(*COMPUTES, "pipeline.stages"))


def growth(mesh: trimesh.Trimesh, config: LearnConfig, seed: int) -> list[dict[str, float]]:
    """Seconds and voxels of learning one object at falling pitches, with true poses."""
    film = film_of(mesh, GROWTH_VIEWS, SEED + 1000 * seed)
    posed = with_true_poses(film)
    rows = []
    for pitch_m in GROWTH_PITCHES_M:
        shape, seconds = _learned(film, posed, replace(config, pitch_m=pitch_m))
        rows.append({"pitch_m": pitch_m, "voxels": shape.phi.size, "seconds": seconds})
    return rows


def _filmed_row(
    film: ObjectFilm, about: Mapping[str, Any], peers: Sequence[str], config: LearnConfig, seed: int
) -> ShapeRow:
    """The row of one film with the poses that `about` names; zeros where no shape can be learned."""
    told = {**about, "supplement": SUPPLEMENT_IOU.get(about["object"])}
    try:
        if about["poses"] == "true":
            row = _row(film, with_true_poses(film), peers, config)
        else:
            posed = with_slam(film, seed, orbit=about["poses"] == "orbit")
            row = _row(film, posed, peers, config.for_tracked_poses)
    except (ValueError, PipelineError) as error:  # there is no object where slam says the views looked
        row = ShapeRow(figures=_failure(film.mesh, config, str(error)), scored={})
    return replace(row, figures=told | row.figures)


def _learned(film: ObjectFilm, posed: PosedFilm, config: LearnConfig) -> tuple[ShapePrior, float]:
    """The shape, and the seconds it took once everything was compiled."""

    def learn() -> ShapePrior:
        return learn_shape(
            jax.random.key(0),
            posed.frames,
            film.recording.intrinsics,
            posed.trajectories,
            posed.log_weights,
            config,
        )

    learn()  # compiles
    begun = time.perf_counter()
    return learn(), time.perf_counter() - begun


def _row(film: ObjectFilm, posed: PosedFilm, peers: Sequence[str], config: LearnConfig) -> ShapeRow:
    learned, seconds = _learned(film, posed, config)
    shape, plane_m = _covering(learned, film.mesh, posed.reference_from_mesh)
    truth = true_voxels(shape, film.mesh, posed.reference_from_mesh)
    near = _from_surface(truth) <= NEAR_VOXELS
    seen = near & (shape.seen_free | shape.seen_occupied)
    scored: dict[str, NDArray[np.floating]] = {OURS: _pair(shape.phi, truth, seen)}
    above = np.arange(shape.phi.shape[2]) * shape.pitch_m >= plane_m - 1e-6  # below it nobody has voxels
    agreement = asdict(shape_agreement(shape, film.mesh, posed.reference_from_mesh))
    within_reach = _not_reached(film, posed, shape.grid) & above | truth
    ceiling = intersection_over_union(within_reach, truth)
    calibrated = calibration(scored[OURS][0], scored[OURS][1] > 0.5)
    figures = {
        "thin": _is_thin(film.mesh, config.pitch_m),
        "voxels": int(truth.sum()),
        **agreement,
        "ceiling": ceiling,
        "reachable": intersection_over_union(shape.solid, within_reach),
        "ratio": agreement["solid"] / ceiling,
        **wall_figures(film, posed.reference_from_mesh, learned, shape.grid),
        **{score: getattr(calibrated, score) if calibrated.count else None for score in SCORES},
        "seconds": seconds,
        "particles": len(posed.trajectories),
        "hidden_occupied": float(truth[shape.enclosed].mean()) if shape.enclosed.any() else None,
        "peers": {},
    }
    if len(posed.trajectories) > 1:
        alone = replace(posed, trajectories=posed.best[None], log_weights=np.zeros(1))
        phi = _laid_over(shape, _learned(film, alone, config)[0])
        scored[LIKELIEST] = _pair(phi, truth, seen)
    views = PosedViews(
        depths_m=[frame.depth_m for frame in posed.frames],
        intrinsics=film.recording.intrinsics,
        reference_from_camera=posed.best,
        support_m=plane_m,
    )
    for peer in peers:
        for setting, build in PEERS[peer].items():
            begun = time.perf_counter()
            phi = build(views, shape.grid)
            elapsed = time.perf_counter() - begun
            solid = _filled((np.isnan(phi) | (phi > 0.5)), above)
            scored[f"{peer}: {setting}"] = _pair(np.where(np.isnan(phi), 0.5, phi), truth, seen)
            found = {"solid": intersection_over_union(solid, truth), "seconds": elapsed}
            figures["peers"].setdefault(peer, {})[setting] = found
    return ShapeRow(figures=figures, scored=scored)


def _failure(mesh: trimesh.Trimesh, config: LearnConfig, problem: str) -> dict[str, Any]:
    """What is counted where no shape could be learned: no agreement at all, and nothing for peers to fill."""
    names = ("solid", "shell", "observed", "ceiling", "ratio", "reachable", "touched", "seconds")
    nothing = dict.fromkeys(names, 0.0)
    unknown = dict.fromkeys((*SCORES, *WALL_FIGURES))
    return {"thin": _is_thin(mesh, config.pitch_m), **nothing, **unknown, "peers": {}, "failed": problem}


def _pair(
    phi: NDArray[np.floating], truth: NDArray[np.bool_], seen: NDArray[np.bool_]
) -> NDArray[np.floating]:
    return np.stack([phi[seen].astype(np.float64), truth[seen].astype(np.float64)])


def _not_reached(film: ObjectFilm, posed: PosedFilm, grid: VoxelGrid) -> NDArray[np.bool_]:
    """Voxels that no noise-free ray reaches from the true poses; `posed` says where the grid stands."""
    moved = film.reference_from_mesh @ np.linalg.inv(posed.reference_from_mesh) @ grid.reference_from_grid
    ideal = [film.recording.ideal_view(number).depth_m for number in range(len(film.frames))]
    at_truth = replace(grid, reference_from_grid=moved)
    return ~reached_voxels(ideal, film.recording.intrinsics, film.trajectory, at_truth)


def _filled(occupied: NDArray[np.bool_], above: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A peer's solid: what it holds occupied or never saw, and cavities that outliers have freed in it."""
    return np.asarray(ndimage.binary_fill_holes(occupied | ~above), np.bool_) & above


def _from_surface(truth: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Distance in voxels of every voxel from the nearest one of the other kind."""
    distance = np.zeros((2, *truth.shape))
    ndimage.distance_transform_edt(truth, distances=distance[0])
    ndimage.distance_transform_edt(~truth, distances=distance[1])
    return distance.max(axis=0)


def _covering(
    shape: ShapePrior, mesh: trimesh.Trimesh, reference_from_mesh: NDArray[np.float64]
) -> tuple[ShapePrior, float]:
    """The same shape on a grid that holds the whole true object, never seen where it was enlarged.

    Returns:
        The shape, and the height of the support plane in its grid.
    """
    grid_from_mesh = np.linalg.inv(shape.reference_from_grid) @ reference_from_mesh
    corners = trimesh.transform_points(mesh.vertices, grid_from_mesh) / shape.pitch_m
    below = np.maximum(np.ceil(-corners.min(axis=0)).astype(int), 0) + 1
    above = np.maximum(np.ceil(corners.max(axis=0) - shape.phi.shape).astype(int), 0) + 1
    pose = shape.reference_from_grid.copy()
    pose[:3, 3] -= pose[:3, :3] @ (below * shape.pitch_m)
    margin = list(zip(below.tolist(), above.tolist(), strict=True))
    masks = {
        name: np.pad(getattr(shape, name), margin) for name in ("seen_free", "seen_occupied", "enclosed")
    }
    phi = np.pad(shape.phi, margin, constant_values=0.5)
    enlarged = replace(shape, phi=phi, reference_from_grid=pose, rgb=None, **masks)
    return enlarged, float(below[2]) * shape.pitch_m


def _laid_over(shape: ShapePrior, other: ShapePrior) -> NDArray[np.float32]:
    """Probabilities of the other shape at the first one's voxels, where its smaller grid has any."""
    other_from_grid = np.linalg.inv(other.reference_from_grid) @ shape.reference_from_grid
    places = trimesh.transform_points(shape.grid.centres_m, other_from_grid) / shape.pitch_m
    phi = ndimage.map_coordinates(other.phi, (places - 0.5).T, order=0, cval=np.nan).reshape(shape.phi.shape)
    return np.where(np.isnan(phi), shape.phi, phi)


def _is_thin(mesh: trimesh.Trimesh, pitch_m: float) -> bool:
    """True if a tenth of the surface belongs to walls thinner than a voxel."""
    points, faces = trimesh.sample.sample_surface(mesh, WALL_SAMPLES, seed=0)[:2]
    inward = -mesh.face_normals[faces]
    caster = RayCaster([Part(name="object", mesh=mesh, world_from_part=np.eye(4))])
    thickness = caster.cast(points + 1e-5 * inward, inward).distance
    return bool((thickness < pitch_m).mean() > THIN_SHARE)
