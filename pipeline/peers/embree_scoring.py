"""The peer of rendering and scoring: Open3D's Embree ray casting, and the depth density in NumPy.

Two settings: every pixel of the image, or only those under the object's bounding sphere, many hypotheses in
one call. The density is that of docs/model.md, section 0 in float32; a pixel that the object does not cover
keeps the density of the background, computed once.
"""

from __future__ import annotations

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics, DepthNoise


class EmbreeScorer:
    """Log likelihoods of hypotheses of one mesh in front of a plane."""

    def __init__(
        self,
        vertices_m: NDArray[np.floating],
        faces: NDArray[np.integer],
        intrinsics: CameraIntrinsics,
        noise: DepthNoise,
        observed_m: NDArray[np.float32],
        background_m: float,
    ) -> None:
        """Build the scene and the densities that no hypothesis changes."""
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(_tensor(vertices_m.astype(np.float32)), _tensor(faces.astype(np.uint32)))
        self._centre = (vertices_m.min(axis=0) + vertices_m.max(axis=0)) / 2
        self._radius_m = float(np.linalg.norm(vertices_m - self._centre, axis=1).max())
        self._intrinsics, self._noise, self._observed_m = intrinsics, noise, observed_m
        self._background_m = background_m
        rest = np.full(observed_m.shape, background_m, np.float32)
        self._density_of_rest = self._log_density(observed_m, rest)

    def whole_image(self, camera_from_object: NDArray[np.float64], together: int = 8) -> NDArray[np.float64]:
        """Log likelihoods (N,), a ray through every pixel; `together` hypotheses in one call."""
        side = np.indices(self._observed_m.shape)
        scores = []
        for start in range(0, len(camera_from_object), together):
            poses = camera_from_object[start : start + together]
            pixels = np.broadcast_to(side[:, None], (2, len(poses), *side.shape[1:]))
            scores.append(self._score(poses, pixels[0], pixels[1]))
        return np.concatenate(scores)

    def under_sphere(
        self, camera_from_object: NDArray[np.float64], together: int = 64
    ) -> NDArray[np.float64]:
        """The same with rays only through the square of pixels that holds the object's sphere."""
        height, width = self._observed_m.shape
        camera = self._intrinsics
        centre = camera_from_object[:, :3, :3] @ self._centre + camera_from_object[:, :3, 3]
        half = self._radius_m * camera.fx / np.sqrt(centre[:, 2] ** 2 - self._radius_m**2)
        reach = int(np.ceil(half.max())) + 1
        window = np.indices((2 * reach, 2 * reach))
        first_row = np.rint(camera.fy * centre[:, 1] / centre[:, 2] + camera.cy).astype(int) - reach
        first_column = np.rint(camera.fx * centre[:, 0] / centre[:, 2] + camera.cx).astype(int) - reach
        first_row = np.clip(first_row, 0, max(height - 2 * reach, 0))[:, None, None]
        first_column = np.clip(first_column, 0, max(width - 2 * reach, 0))[:, None, None]
        scores = []
        for start in range(0, len(camera_from_object), together):
            part = slice(start, start + together)
            rows = np.minimum(first_row[part] + window[0], height - 1)
            columns = np.minimum(first_column[part] + window[1], width - 1)
            scores.append(self._score(camera_from_object[part], rows, columns))
        return np.concatenate(scores)

    def _score(
        self, poses: NDArray[np.float64], rows: NDArray[np.int64], columns: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Log likelihoods (n,) with rays through pixels (n, h, w)."""
        camera = self._intrinsics
        direction = np.ones((*rows.shape, 3), np.float32)
        direction[..., 0] = (columns - camera.cx) / camera.fx
        direction[..., 1] = (rows - camera.cy) / camera.fy
        rotation = poses[:, :3, :3].astype(np.float32)
        origin = -np.einsum("nba,nb->na", poses[:, :3, :3], poses[:, :3, 3]).astype(np.float32)
        rays = np.empty((*rows.shape, 6), np.float32)
        rays[..., :3] = origin[:, None, None]
        rays[..., 3:] = (direction.reshape(len(poses), -1, 3) @ rotation).reshape(direction.shape)
        depth = self._scene.cast_rays(_tensor(rays))["t_hit"].numpy()
        covers = depth < self._background_m
        observed = self._observed_m[rows, columns]
        density = self._log_density(observed, np.where(covers, depth, np.float32(1)))
        gain = np.where(covers, density - self._density_of_rest[rows, columns], 0)
        return gain.sum(axis=(1, 2), dtype=np.float64)

    def _log_density(
        self, observed_m: NDArray[np.float32], rendered_m: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        noise = self._noise
        sigma = noise.sigma_base_m + noise.sigma_growth_per_m * (rendered_m - 0.4) ** 2
        normal = np.exp(-0.5 * ((observed_m - rendered_m) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
        uniform = (observed_m <= noise.max_range_m) / np.float32(noise.max_range_m)
        inlier = (1 - noise.outlier_probability) * normal
        real = (1 - noise.none_hit_probability) * (noise.outlier_probability * uniform + inlier)
        density = np.where(observed_m == 0, noise.none_hit_probability, real)
        return np.log(np.maximum(density, 1e-37)).astype(np.float32)


def _tensor(values: NDArray) -> o3d.core.Tensor:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values))
