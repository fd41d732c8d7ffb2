"""Rigid surfaces standing in a world, and what rays meet there (Open3D's Embree ray casting)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import open3d as o3d
import trimesh
from numpy.typing import NDArray

from pipeline.meshes import vertex_rgb
from recordings.types import CameraIntrinsics

NOTHING = -1
"""Part index where a ray meets nothing."""
INSIDE_RAYS = 7
"""Rays that vote on whether a point is inside; odd, so that leaks of one face do not decide."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """One rigid surface of a world.

    Attributes:
        name: what it is; an object of interest, a piece of furniture, the room's shell.
        mesh: its surface in metres in its own frame.
        world_from_part: (4, 4) rigid transform.
        colour: flat RGB in 0..255, where the mesh has no colours of vertices.
    """

    name: str
    mesh: trimesh.Trimesh
    world_from_part: NDArray[np.float64]
    colour: tuple[int, int, int] = (160, 160, 160)


@dataclass(frozen=True, kw_only=True, eq=False)
class Hits:
    """What rays (...) met first.

    Attributes:
        distance: (...) float32 in lengths of the ray's direction, infinite where nothing was met.
        normal: (..., 3) float32 unit normal of the surface in the world frame.
        part: (...) int32 index of the part, or `NOTHING`.
        face: (...) int64 row of the part's faces; without meaning where nothing was met.
        corners: (..., 2) float32 weights of the face's second and third vertex.
    """

    distance: NDArray[np.float32]
    normal: NDArray[np.float32]
    part: NDArray[np.int32]
    face: NDArray[np.int64]
    corners: NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """What an ideal camera sees.

    Attributes:
        depth_m: (H, W) float32 along the optical axis, infinite where nothing is met.
        cos_incidence: (H, W) float32 cosine between the ray and the surface normal, in [0, 1].
        part: (H, W) int32 index of the part, or `NOTHING`.
        rgb: (H, W, 3) float32 the surfaces' own colours, 0..255; black where nothing is met.
    """

    depth_m: NDArray[np.float32]
    cos_incidence: NDArray[np.float32]
    part: NDArray[np.int32]
    rgb: NDArray[np.float32]


class RayCaster:
    """First intersections of rays with a sequence of parts."""

    def __init__(self, parts: Sequence[Part]) -> None:
        """Build the acceleration structure over `parts`."""
        self.parts = tuple(parts)
        self._scene = o3d.t.geometry.RaycastingScene()
        for part in self.parts:
            vertices = trimesh.transform_points(part.mesh.vertices, part.world_from_part)
            self._scene.add_triangles(
                _tensor(vertices.astype(np.float32)), _tensor(part.mesh.faces.astype(np.uint32))
            )

    def cast(self, origins_m: NDArray[np.floating], directions: NDArray[np.floating]) -> Hits:
        """First hits of rays (..., 3), (..., 3) that broadcast against each other."""
        origins_m, directions = np.broadcast_arrays(origins_m, directions)
        rays = np.concatenate([origins_m, directions], axis=-1, dtype=np.float32)
        answer = self._scene.cast_rays(_tensor(rays))
        part = answer["geometry_ids"].numpy().astype(np.int64)
        part[part == self._scene.INVALID_ID] = NOTHING
        return Hits(
            distance=answer["t_hit"].numpy(),
            normal=answer["primitive_normals"].numpy(),
            part=part.astype(np.int32),
            face=answer["primitive_ids"].numpy().astype(np.int64),
            corners=answer["primitive_uvs"].numpy(),
        )

    def view(self, intrinsics: CameraIntrinsics, world_from_camera: NDArray[np.float64]) -> View:
        """The ideal image of a camera; rays go through the integer pixel centres."""
        directions = pixel_directions(intrinsics) @ world_from_camera[:3, :3].T
        hits = self.cast(world_from_camera[:3, 3], directions)
        cosine = np.einsum("hwc,hwc->hw", hits.normal, directions) / np.linalg.norm(directions, axis=-1)
        return View(
            depth_m=hits.distance,
            cos_incidence=np.abs(cosine).astype(np.float32),
            part=hits.part,
            rgb=self._colours(hits),
        )

    def _colours(self, hits: Hits) -> NDArray[np.float32]:
        """Own colours (..., 3) of the surfaces, 0..255."""
        palette = np.array([part.colour for part in self.parts] + [(0, 0, 0)], np.float32)
        rgb = palette[hits.part]
        for number, part in enumerate(self.parts):
            painted = vertex_rgb(part.mesh)
            met = hits.part == number
            if painted is not None and met.any():
                second, third = hits.corners[met].T
                weights = np.stack([1 - second - third, second, third], axis=1)
                corners = painted[part.mesh.faces[hits.face[met]]].astype(np.float32)
                rgb[met] = (weights[..., None] * corners).sum(axis=1)
        return rgb

    def holds(self, points_m: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Whether points (N, 3) lie inside the parts, by the parity of surfaces that rays cross."""
        inside = self._scene.compute_occupancy(_tensor(points_m.astype(np.float32)), nsamples=INSIDE_RAYS)
        return np.asarray(inside.numpy() > 0.5)

    def clearance_m(self, points_m: NDArray[np.floating]) -> NDArray[np.float32]:
        """Distance from points (N, 3) to the nearest surface."""
        return self._scene.compute_distance(_tensor(points_m.astype(np.float32))).numpy()


def pixel_directions(intrinsics: CameraIntrinsics) -> NDArray[np.float64]:
    """Directions (H, W, 3) through the pixel centres in the camera frame, scaled to z = 1."""
    return intrinsics.rays(np.arange(intrinsics.width)[None, :], np.arange(intrinsics.height)[:, None])


def _tensor(values: NDArray) -> o3d.core.Tensor:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values))
