"""The region that learning would take, drawn on the first frame: nothing is learned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from pipeline.atomic import atomic_path
from pipeline.errors import PipelineError
from pipeline.report.pictures import depth_pixels
from pipeline.session import Session
from pipeline.stages.learn import learn_config, posed_frames, used_frames
from recordings.types import CameraIntrinsics, Frame
from shapes.geometry.poses import transform_points
from shapes.learning.region import object_grid
from shapes.voxel_grid import VoxelGrid

LINE_COLOUR = (255, 120, 0)
LINE_PX = 2
NEAREST_M = 0.01
"""Corners nearer to the camera's plane than this are drawn there."""


@dataclass(frozen=True, kw_only=True)
class LearnedRegion:
    """A box of voxels.

    Attributes:
        size_m: of its edges.
        voxels: in it.
    """

    size_m: tuple[float, ...]
    voxels: int


def preview_region(
    session: Session, options: Mapping[str, Any], picture: Path, *, recorded_poses: bool = False
) -> LearnedRegion:
    """Find the region as `learn` would, and draw it on the first frame that would be used.

    Raises:
        PipelineError: there is no object to learn; the message says why.
    """
    config = learn_config(session, options)
    posed = posed_frames(session, recorded_poses=recorded_poses)
    frames, used = used_frames(session, posed, config)
    poses = used.trajectories[int(np.argmax(used.log_weights))]
    camera = session.recording.intrinsics
    try:
        grid = object_grid([frame.depth_m for frame in frames], camera, poses, config)
    except ValueError as error:
        raise PipelineError(f"{session.source.path}: {error}") from error
    image = drawn(frames[0], camera, grid, np.linalg.inv(poses[0]) @ grid.reference_from_grid)
    with atomic_path(picture) as partial:
        image.save(partial)
    return LearnedRegion(size_m=tuple(side * grid.pitch_m for side in grid.shape), voxels=len(grid))


def drawn(
    frame: Frame, intrinsics: CameraIntrinsics, grid: VoxelGrid, camera_from_grid: NDArray[np.float64]
) -> Image.Image:
    """The frame, in colour where it has some, with the edges of a grid."""
    pixels = depth_pixels(frame.depth_m) if frame.rgb is None else frame.rgb
    image = Image.fromarray(np.asarray(pixels, np.uint8))
    canvas = ImageDraw.Draw(image)
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)
    points = corners * np.asarray(grid.shape) * grid.pitch_m
    x, y, z = transform_points(camera_from_grid, points).T
    z = np.maximum(z, NEAREST_M)
    seen = np.stack([intrinsics.fx * x / z + intrinsics.cx, intrinsics.fy * y / z + intrinsics.cy], axis=1)
    for one in range(8):
        for other in range(one + 1, 8):
            if np.abs(corners[one] - corners[other]).sum() == 1:
                ends = [tuple(seen[one].tolist()), tuple(seen[other].tolist())]
                canvas.line(ends, fill=LINE_COLOUR, width=LINE_PX)
    return image
