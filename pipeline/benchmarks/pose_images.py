"""Images of `bench poses`: depth, everything that is true of it, and what registration peers get of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import open3d as o3d
import trimesh
from numpy.typing import NDArray

from pipeline.synthesis.world import NOTHING, Part, RayCaster
from recordings.truth import SceneTruth, TrueObject
from recordings.types import CameraIntrinsics, DepthNoise, Frame
from scene.observation.depth_view import unproject
from shapes.geometry.camera import Camera

if TYPE_CHECKING:
    from collections.abc import Mapping

ON_TABLE_M = 0.006
"""Points nearer to the support plane belong to it."""
MASK_M = 0.012
"""A pixel shows an object if it measures its surface within this."""
PLANE_SAMPLES = 500
"""Triples drawn for the support plane of images whose truth does not tell it."""


@dataclass(frozen=True, order=True)
class ImageKey:
    """An image's place in its data set.

    Attributes:
        kind: of image; rows of a kind stand together.
        scene_id: BOP's number of its scene.
        im_id: and of the image in it.
    """

    kind: str
    scene_id: int
    im_id: int

    def __str__(self) -> str:
        return f"{self.kind} {self.scene_id} {self.im_id}"


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseImage:
    """One image.

    Attributes:
        key: its place.
        frame: what the camera measured.
        intrinsics: of the camera.
        truth: the objects; all of them are judged.
        camera_from_world: (4, 4), the world being that of the truth.
        meshes: true surfaces by shape.
        absent: shapes that are asked for and not there.
        noise: of the sensor, as `parse` is told.
    """

    key: ImageKey
    frame: Frame
    intrinsics: CameraIntrinsics
    truth: SceneTruth
    camera_from_world: NDArray[np.float64]
    meshes: Mapping[str, trimesh.Trimesh]
    absent: tuple[str, ...] = ()
    noise: DepthNoise = field(default_factory=DepthNoise)

    @property
    def objects(self) -> tuple[TrueObject, ...]:
        """What is there."""
        return self.truth.objects

    @property
    def shapes(self) -> list[str]:
        """Names of the shapes that are there."""
        return list(dict.fromkeys(one.shape for one in self.objects))

    @cached_property
    def parts(self) -> list[Part]:
        """The objects' true surfaces in the camera's frame."""
        return [
            Part(
                name=one.name,
                mesh=self.meshes[one.shape],
                world_from_part=self.camera_from_world @ one.world_from_object,
            )
            for one in self.objects
        ]

    @cached_property
    def owners(self) -> NDArray[np.int32]:
        """(H, W) index of the object that each pixel shows by its depth and the truth, else `NOTHING`."""
        view = RayCaster(self.parts).view(self.intrinsics, np.eye(4))
        agrees = np.abs(np.where(np.isfinite(view.depth_m), view.depth_m, 0) - self.frame.depth_m) < MASK_M
        return np.where(agrees & (self.frame.depth_m > 0), view.part, NOTHING)

    def points(self, one: int, *, masked: bool) -> NDArray[np.float64]:
        """What a peer gets for the object of that index: camera points (N, 3) over the support plane.

        Args:
            one: index of the object.
            masked: only those that show the object itself.
        """
        return self._points[(self.owners == one)[self._measured]] if masked else self._points[self._above]

    @cached_property
    def _measured(self) -> NDArray[np.bool_]:
        return self.frame.depth_m > 0

    @cached_property
    def _points(self) -> NDArray[np.float64]:
        camera = Camera.from_intrinsics(self.intrinsics)
        return np.asarray(unproject(self.frame.depth_m, camera)[self._measured], np.float64)

    @cached_property
    def _above(self) -> NDArray[np.bool_]:
        """(N,) points over the true support plane, or off the plane that holds most of them."""
        plane = self.truth.support_plane
        if plane is None:
            o3d.utility.random.seed(0)
            cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(self._points))
            on_plane = cloud.segment_plane(2 * ON_TABLE_M, 3, PLANE_SAMPLES)[1]
            above = np.ones(len(self._points), bool)
            above[on_plane] = False
            return above
        world = trimesh.transform_points(self._points, np.linalg.inv(self.camera_from_world))
        return world @ plane[:3] + plane[3] > ON_TABLE_M
