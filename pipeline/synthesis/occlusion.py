"""A box before the camera and a mug that may hide behind it: supplement L, Fig. 7.

The supplement tells neither sizes nor places; these are ours. Images are rendered by Embree and drawn from
the figure's likelihood: a pixel shows anything up to D in a tenth of the cases, D where no object is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.synthesis.colours import shape_colour
from pipeline.synthesis.world import Part, RayCaster
from recordings.types import CameraIntrinsics, DepthNoise

FAR_M = 2.0
"""D, the depth that a pixel without an object shows."""

SIGMA_M = 0.005

NOISE = DepthNoise(
    sigma_base_m=SIGMA_M,
    sigma_growth_per_m=0.0,
    outlier_probability=0.1,
    none_hit_probability=0.0,
    none_miss_probability=0.0,
    max_range_m=FAR_M,
)
"""The figure's likelihood: 0.1 / D + 0.9 Normal, every pixel with a return."""

PRESENCE = 0.9
"""Prior probability of each object (Fig. 7)."""

LOW_M, HIGH_M = np.array([-0.22, -0.16, 0.55]), np.array([0.22, 0.16, 1.25])
"""Corners of the cuboid that holds objects, all of it in sight, x right, y down and z ahead."""

GRID_POINTS = 32
"""Along each side of the cuboid, by which its hidden share is counted."""

SCENES: Mapping[str, tuple[float, float]] = {
    "turned": (75.0, 0.85),
    "wide": (0.0, 0.85),
    "closer": (0.0, 0.65),
}
"""Yaw in degrees and distance in metres of the box in Fig. 7 (d), (c) and (e)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OcclusionScene:
    """One depth image of the world.

    Attributes:
        name: of the scene.
        camera: of the image.
        camera_from_object: (4, 4) by name, of what is there.
        ideal_m: (H, W) depth without noise.
        depth_m: (H, W) as measured.
    """

    name: str
    camera: CameraIntrinsics
    camera_from_object: Mapping[str, NDArray[np.float64]]
    ideal_m: NDArray[np.float32]
    depth_m: NDArray[np.float32]


def occlusion_camera(width: int) -> CameraIntrinsics:
    """A camera of 60 degrees across."""
    height = 3 * width // 4
    focal = width / 2 / np.tan(np.radians(30.0))
    return CameraIntrinsics(
        width=width, height=height, fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2
    )


def box_pose(yaw_deg: float, x_m: float, distance_m: float) -> NDArray[np.float64]:
    """Pose (4, 4) camera_from_box of an upright box; yaw 0 shows its wide face."""
    pose = np.eye(4)
    upright = Rotation.from_euler("x", 90, degrees=True)
    pose[:3, :3] = (Rotation.from_euler("y", yaw_deg, degrees=True) * upright).as_matrix()
    pose[:3, 3] = x_m, 0.0, distance_m
    return pose


def random_box_pose(rng: np.random.Generator) -> NDArray[np.float64]:
    """An upright box somewhere in the nearer half of the cuboid, turned anyhow."""
    return box_pose(rng.uniform(-90, 90), rng.uniform(-0.1, 0.1), rng.uniform(0.65, 0.95))


def occlusion_scene(
    name: str,
    meshes: Mapping[str, trimesh.Trimesh],
    poses: Mapping[str, NDArray[np.float64]],
    camera: CameraIntrinsics,
    seed: Sequence[int],
) -> OcclusionScene:
    """The image of objects at poses camera_from_object; meshes are centred on their boxes."""
    rng = np.random.default_rng(seed)
    ideal_m = np.full((camera.height, camera.width), FAR_M, np.float32)
    if poses:
        parts = [
            Part(name=one, mesh=meshes[one], world_from_part=pose, colour=shape_colour(one))
            for one, pose in poses.items()
        ]
        ideal_m = np.minimum(RayCaster(parts).view(camera, np.eye(4)).depth_m, FAR_M)
    anything = rng.uniform(size=ideal_m.shape) < NOISE.outlier_probability
    measured = ideal_m + SIGMA_M * rng.standard_normal(ideal_m.shape)
    depth_m = np.where(anything, rng.uniform(0, FAR_M, ideal_m.shape), measured).astype(np.float32)
    return OcclusionScene(
        name=name, camera=camera, camera_from_object=dict(poses), ideal_m=ideal_m, depth_m=depth_m
    )


def hidden_fraction(scene: OcclusionScene) -> float:
    """Share of the cuboid behind what the camera sees, or out of its sight, by a grid of points."""
    axes = [
        low + (high - low) * (np.arange(GRID_POINTS) + 0.5) / GRID_POINTS
        for low, high in zip(LOW_M, HIGH_M, strict=True)
    ]
    x, y, z = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
    columns = np.rint(x / z * scene.camera.fx + scene.camera.cx).astype(int)
    rows = np.rint(y / z * scene.camera.fy + scene.camera.cy).astype(int)
    height, width = scene.ideal_m.shape
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    shown_m = scene.ideal_m[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
    return float((~inside | (z > shown_m)).mean())
