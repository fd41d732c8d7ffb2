"""Registration of known objects: FPFH features with RANSAC, point-pair features, ICP from 24 rotations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
import open3d as o3d
import trimesh
from numpy.typing import NDArray

from scene.objects.orientations import cube_rotations

MODEL_POINTS = 4000
RANSAC_ITERATIONS = 50_000
ICP_ITERATIONS = 40
PAIR_STEP = 0.05
"""Sampling of model and scene as a share of the model's diameter: OpenCV's default."""
PAIR_VOXEL_M = 0.003
PAIR_POSES = 5
"""Of the poses that most pairs vote for, so many are refined."""
NORMAL_NEIGHBOURS, FEATURE_NEIGHBOURS = 30, 100

Register = Callable[["Model", "NDArray[np.float64]"], "NDArray[np.float64] | None"]
"""(model, observed points (N, 3) in the camera frame) -> camera_from_object (4, 4), if any is found."""


@dataclass(frozen=True, eq=False)
class Model:
    """Points (N, 3) and outward normals of an object's whole surface, in its own frame."""

    points_m: NDArray[np.float64]
    normals: NDArray[np.float64]

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> Model:
        """The same points at each call."""
        points, faces = trimesh.sample.sample_surface(mesh, MODEL_POINTS, seed=0)[:2]
        return cls(np.asarray(points, np.float64), np.asarray(mesh.face_normals[faces], np.float64))


def settings() -> Mapping[str, Mapping[str, Register]]:
    """Settings of each peer, of which the best on tuning tables is taken."""
    return {
        "fpfh": {f"{1000 * voxel:g} mm": partial(fpfh_ransac_icp, voxel_m=voxel) for voxel in (0.003, 0.005)},
        "icp24": {
            f"{1000 * voxel:g} mm": partial(icp_from_rotations, voxel_m=voxel) for voxel in (0.003, 0.005)
        },
        "ppf": {f"step {PAIR_STEP:g}": partial(point_pair_features_icp, step=PAIR_STEP)},
    }


def fpfh_ransac_icp(model: Model, observed_m: NDArray[np.float64], *, voxel_m: float) -> NDArray[np.float64]:
    """Rusu et al. 2009, with Open3D's recommended ratios of radii to the voxel."""
    o3d.utility.random.seed(0)
    source, target = _model_cloud(model, voxel_m), _cloud(observed_m, voxel_m)
    source_feature, target_feature = (
        o3d.pipelines.registration.compute_fpfh_feature(
            cloud, o3d.geometry.KDTreeSearchParamHybrid(5 * voxel_m, FEATURE_NEIGHBOURS)
        )  # pyright: ignore[reportCallIssue]
        for cloud in (source, target)
    )
    checkers = [
        o3d.pipelines.registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
        o3d.pipelines.registration.CorrespondenceCheckerBasedOnDistance(1.5 * voxel_m),
    ]
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        coarse = o3d.pipelines.registration.registration_ransac_based_on_feature_matching(
            source,
            target,
            source_feature,
            target_feature,
            True,
            1.5 * voxel_m,
            o3d.pipelines.registration.TransformationEstimationPointToPoint(False),
            3,
            checkers,
            o3d.pipelines.registration.RANSACConvergenceCriteria(RANSAC_ITERATIONS, 0.999),
        )
    return _icp(source, target, coarse.transformation, 2 * voxel_m).transformation


def icp_from_rotations(
    model: Model, observed_m: NDArray[np.float64], *, voxel_m: float
) -> NDArray[np.float64]:
    """ICP from the 24 rotations of a cube about the observed points' middle; the best fit is kept."""
    source, target = _model_cloud(model, voxel_m), _cloud(observed_m, voxel_m)
    middle = np.median(observed_m, axis=0)
    best = None
    for rotation in cube_rotations():
        start = np.eye(4)
        start[:3, :3] = rotation
        start[:3, 3] = middle - rotation @ model.points_m.mean(axis=0)
        for reach in (0.03, 2 * voxel_m):
            result = _icp(source, target, start, reach)
            start = result.transformation
        if best is None or result.fitness > best.fitness:
            best = result
    assert best is not None
    return np.asarray(best.transformation)


def point_pair_features_icp(
    model: Model, observed_m: NDArray[np.float64], *, step: float
) -> NDArray[np.float64] | None:
    """Drost et al. 2010, as OpenCV has it; the best of the first few poses after ICP."""
    target = _cloud(observed_m, PAIR_VOXEL_M)
    scene = np.hstack([np.asarray(target.points), np.asarray(target.normals)]).astype(np.float32)
    found = _pair_detector(model, step).match(scene, 1 / 5, step)
    source = _model_cloud(model, PAIR_VOXEL_M)
    refined = [
        _icp(source, target, np.asarray(one.pose, np.float64), 2 * PAIR_VOXEL_M) for one in found[:PAIR_POSES]
    ]
    best = max(refined, key=lambda result: result.fitness, default=None)
    return None if best is None else np.asarray(best.transformation)


@lru_cache(maxsize=64)
def _pair_detector(model: Model, step: float) -> Any:
    """A trained detector of one model (extra `bench`)."""
    import cv2  # pyright: ignore[reportMissingImports]

    detector = cv2.ppf_match_3d.PPF3DDetector(step, step)
    # sampled as the detector would: it trains on the square of the points that it is given
    cloud = _model_cloud(model, step * float(np.linalg.norm(np.ptp(model.points_m, axis=0))))
    detector.trainModel(np.hstack([np.asarray(cloud.points), np.asarray(cloud.normals)]).astype(np.float32))
    return detector


def _icp(
    source: o3d.geometry.PointCloud,
    target: o3d.geometry.PointCloud,
    start: NDArray[np.float64],
    reach_m: float,
) -> o3d.pipelines.registration.RegistrationResult:
    return o3d.pipelines.registration.registration_icp(
        source,
        target,
        reach_m,
        start,
        o3d.pipelines.registration.TransformationEstimationPointToPlane(),
        o3d.pipelines.registration.ICPConvergenceCriteria(max_iteration=ICP_ITERATIONS),
    )


def _model_cloud(model: Model, voxel_m: float) -> o3d.geometry.PointCloud:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(model.points_m))
    cloud.normals = o3d.utility.Vector3dVector(model.normals)
    return cloud.voxel_down_sample(voxel_m)


def _cloud(points_m: NDArray[np.float64], voxel_m: float) -> o3d.geometry.PointCloud:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m)).voxel_down_sample(voxel_m)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(3 * voxel_m, NORMAL_NEIGHBOURS))
    cloud.orient_normals_towards_camera_location()
    return cloud
