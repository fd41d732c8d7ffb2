"""`bench shapes`: the supplement's Table 1, with calibration, the ceiling of the views, and peers."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import jax
import numpy as np
import open3d as o3d
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from pipeline.evaluation.calibration import calibration, reliability
from pipeline.evaluation.shapes import intersection_over_union, shape_agreement, true_voxels
from pipeline.peers.voxel_maps import PosedViews, VoxelMap, octomap, open3d_tsdf, space_carving
from pipeline.synthesis.filming import film_object
from pipeline.synthesis.paths import PathConfig
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import CameraConfig, ObjectScene
from shapes.learning.config import LearnConfig
from shapes.learning.distillation import learn_shape
from shapes.learning.grid import VoxelGrid
from shapes.prior import ShapePrior

SUPPLEMENT_IOU = 0.957
"""Mean of Table 1; its pitch, interior rule and poses are not stated."""
SEED = 51_000
"""Of the films; none of a test's."""
CAMERA = CameraConfig(width=640, height=480)
ROOM = RoomConfig(kind="furnished")
PEERS: Mapping[str, Mapping[str, VoxelMap]] = {
    "carving": {
        f"margin {margin:g} pitches, {votes} views": space_carving(margin, votes)
        for margin in (0.0, 0.3, 0.6, 1.0)
        for votes in (1, 2)
    },
    "octomap": {f"hit {hit:g}, miss {miss:g}": octomap(hit, miss) for hit, miss in ((0.7, 0.4), (0.6, 0.45))},
    "tsdf": {f"truncation {pitches:g} pitches": open3d_tsdf(pitches) for pitches in (2.0, 4.0)},
}
"""Every peer with the settings it may choose from: the best mean over the run's own objects is printed."""
NEAR_VOXELS = 3.0
"""Calibration is scored so near to the true surface."""
WALL_SAMPLES = 2000
THIN_SHARE = 0.1


@dataclass(frozen=True, kw_only=True)
class Filmed:
    """One object on film: what learning gets, and what it is compared with."""

    name: str
    mesh: trimesh.Trimesh
    recording: SyntheticRecording
    reference_from_mesh: NDArray[np.float64]
    trajectory: NDArray[np.float64]


def measure_shapes(
    meshes: Mapping[str, trimesh.Trimesh],
    views: Sequence[int],
    peers: Sequence[str],
    config: LearnConfig,
    seed: int,
    on_object: Callable[[int, int], None],
) -> dict[str, Any]:
    """Learn every mesh from every number of views, with true poses; rows by object and number."""
    rows, pooled = [], {}
    total = len(meshes) * len(views)
    for count in views:
        seen: dict[str, list[NDArray]] = {}
        for number, (name, mesh) in enumerate(sorted(meshes.items())):
            film = _filmed(name, mesh, count, SEED + 1000 * seed + number)
            rows.append({"object": name, "views": count, **_row(film, peers, config, seen)})
            on_object(len(rows), total)
        pooled[str(count)] = {
            method: _pooled(np.concatenate(pairs, axis=1)) for method, pairs in seen.items()
        }
    return {
        "pitch_m": config.pitch_m,
        "supplement_iou": SUPPLEMENT_IOU,
        "rows": rows,
        "calibration": pooled,
        "means": _means(rows, views),
    }


def _filmed(name: str, mesh: trimesh.Trimesh, views: int, seed: int) -> Filmed:
    scene = ObjectScene(
        camera=CAMERA,
        room=ROOM,
        path=PathConfig(kind="rings", frames=views, radius_m=0.8, elevations_deg=(25.0, 55.0)),
    )
    recording = film_object(name, mesh, scene, seed)
    poses = recording.trajectory.reference_from_camera
    reference_from_world = np.linalg.inv(poses[0])
    return Filmed(
        name=name,
        mesh=mesh,
        recording=recording,
        reference_from_mesh=reference_from_world @ recording.truth.objects[0].world_from_object,
        trajectory=reference_from_world @ poses,
    )


def _row(film: Filmed, peers: Sequence[str], config: LearnConfig, seen: dict[str, list]) -> dict[str, Any]:
    frames = list(film.recording)
    intrinsics = film.recording.intrinsics
    key = jax.random.key(0)

    def learn() -> ShapePrior:
        return learn_shape(key, frames, intrinsics, film.trajectory[None], np.zeros(1), config)

    learn()  # compiles
    begun = time.perf_counter()
    shape = learn()
    seconds = time.perf_counter() - begun
    shape, plane_m = _covering(shape, film)
    truth = true_voxels(shape, film.mesh, film.reference_from_mesh)
    agreement = shape_agreement(shape, film.mesh, film.reference_from_mesh)
    grid = VoxelGrid(
        shape=shape.phi.shape,  # type: ignore[arg-type]
        pitch_m=shape.pitch_m,
        reference_from_grid=shape.reference_from_grid,
        on_plane=False,
    )
    near = _from_surface(truth) <= NEAR_VOXELS
    scored = near & (shape.seen_free | shape.seen_occupied)
    _keep(seen, "voxscene", shape.phi, truth, scored)
    ideal = [film.recording.ideal_view(number).depth_m for number in range(len(frames))]
    reached = reached_voxels(ideal, film, grid)
    above = np.arange(shape.phi.shape[2]) * shape.pitch_m >= plane_m - 1e-6  # below it nobody has voxels
    ceiling = intersection_over_union(truth | (~reached & above), truth)
    row = {
        "thin": _is_thin(film.mesh, config.pitch_m),
        "voxels": int(truth.sum()),
        **asdict(agreement),
        "ceiling": ceiling,
        "seconds": seconds,
        "hidden_occupied": float(truth[shape.enclosed].mean()) if shape.enclosed.any() else None,
        "peers": {},
    }
    posed = PosedViews(
        depths_m=[frame.depth_m for frame in frames],
        intrinsics=intrinsics,
        reference_from_camera=film.trajectory,
    )
    for peer in peers:
        for setting, build in PEERS[peer].items():
            begun = time.perf_counter()
            phi = build(posed, grid)
            elapsed = time.perf_counter() - begun
            solid = (np.isnan(phi) | (phi > 0.5)) & above
            _keep(seen, f"{peer}: {setting}", np.where(np.isnan(phi), 0.5, phi), truth, scored)
            found = {"solid": intersection_over_union(solid, truth), "seconds": elapsed}
            row["peers"].setdefault(peer, {})[setting] = found
    return row


def _from_surface(truth: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Distance in voxels of every voxel from the nearest one of the other kind."""
    distance = np.zeros((2, *truth.shape))
    distance_transform_edt(truth, distances=distance[0])
    distance_transform_edt(~truth, distances=distance[1])
    return distance.max(axis=0)


def _keep(seen: dict, method: str, phi: NDArray, truth: NDArray[np.bool_], scored: NDArray[np.bool_]) -> None:
    seen.setdefault(method, []).append(np.stack([phi[scored], truth[scored]]).astype(np.float64))


def _pooled(pairs: NDArray[np.float64]) -> dict[str, Any]:
    phi, truth = pairs[0], pairs[1] > 0.5
    return {**asdict(calibration(phi, truth)), "reliability": reliability(phi, truth)}


def _covering(shape: ShapePrior, film: Filmed) -> tuple[ShapePrior, float]:
    """The same shape on a grid that holds the whole true object, never seen where it was enlarged.

    Returns:
        The shape, and the height of the support plane in its grid.
    """
    grid_from_mesh = np.linalg.inv(shape.reference_from_grid) @ film.reference_from_mesh
    corners = trimesh.transform_points(film.mesh.vertices, grid_from_mesh) / shape.pitch_m
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


def reached_voxels(
    depths_m: Sequence[NDArray[np.float32]], film: Filmed, grid: VoxelGrid
) -> NDArray[np.bool_]:
    """Voxels (I, J, K) through which some noise-free ray passes before it meets a surface."""
    intrinsics = film.recording.intrinsics
    reached = np.zeros(len(grid), np.bool_)
    step = grid.pitch_m / 2
    for depth, pose in zip(depths_m, film.trajectory, strict=True):
        grid_from_camera = np.linalg.inv(grid.reference_from_grid) @ pose
        eye, extent = grid_from_camera[:3, 3], np.asarray(grid.shape) * grid.pitch_m
        stride = max(1, int(step * intrinsics.fx / np.linalg.norm(eye - extent / 2)))
        rows, columns = np.mgrid[0 : intrinsics.height : stride, 0 : intrinsics.width : stride]
        x, y = (columns - intrinsics.cx) / intrinsics.fx, (rows - intrinsics.cy) / intrinsics.fy
        directions = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ grid_from_camera[:3, :3].T
        with np.errstate(divide="ignore"):
            sides = np.stack([-eye / directions, (extent - eye) / directions])
        enter, leave = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
        end = np.minimum(leave, depth[::stride, ::stride].reshape(-1))
        passing = (enter < end) & (end > 0)
        directions, enter, end = directions[passing], enter[passing], end[passing]
        for number in range(int(np.ceil((end - enter).max(initial=0.0) / step)) + 1):
            s = enter + (number + 0.5) * step
            points = eye + directions[s < end] * s[s < end, None]
            index = np.clip(np.floor(points / grid.pitch_m).astype(int), 0, np.asarray(grid.shape) - 1)
            reached[np.ravel_multi_index(tuple(index.T), grid.shape)] = True
    return reached.reshape(grid.shape)


def _is_thin(mesh: trimesh.Trimesh, pitch_m: float) -> bool:
    """True if a tenth of the surface belongs to walls thinner than a voxel."""
    points, faces = trimesh.sample.sample_surface(mesh, WALL_SAMPLES, seed=0)[:2]
    inward = -mesh.face_normals[faces]
    scene = o3d.t.geometry.RaycastingScene()
    tensor = o3d.core.Tensor.from_numpy
    scene.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(mesh.faces.astype(np.uint32)))
    rays = np.concatenate([points + 1e-5 * inward, inward], axis=1).astype(np.float32)
    thickness = scene.cast_rays(tensor(rays))["t_hit"].numpy()
    return bool((thickness < pitch_m).mean() > THIN_SHARE)


def _means(rows: Sequence[Mapping[str, Any]], views: Sequence[int]) -> list[dict[str, Any]]:
    """Means over all objects, and over those with thick and with thin walls, by number of views."""
    means = []
    for count in views:
        for kind, kept in (("all", (True, False)), ("thick", (False,)), ("thin", (True,))):
            part = [row for row in rows if row["views"] == count and row["thin"] in kept]
            if part:
                means.append({"views": count, "walls": kind, "objects": len(part), **_mean(part)})
    return means


def _mean(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    figures: dict[str, Any] = {
        key: float(np.mean([row[key] for row in rows]))
        for key in ("solid", "shell", "observed", "ceiling", "seconds")
    }
    draws = np.random.default_rng(0).integers(len(rows), size=(1000, len(rows)))
    solid = np.asarray([row["solid"] for row in rows])[draws].mean(axis=1)
    figures["solid_95"] = [float(value) for value in np.quantile(solid, [0.025, 0.975])]
    peers = {}
    for peer, settings in rows[0]["peers"].items():
        scores = {
            setting: float(np.mean([row["peers"][peer][setting]["solid"] for row in rows]))
            for setting in settings
        }
        best = max(scores, key=lambda setting: scores[setting])
        peers[peer] = {"solid": scores[best], "setting": best}
    return {**figures, "peers": peers}
