"""A learned surface against depth that learning did not get."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.export.meshes import as_trimesh
from pipeline.synthesis.world import Part, RayCaster
from recordings.types import NO_RETURN, CameraIntrinsics, Frame, Trajectory
from shapes.learning.config import LearnConfig
from shapes.learning.distillation import select_views
from shapes.prior import ShapePrior


@dataclass(frozen=True, kw_only=True)
class HeldBack:
    """Distances along the rays between a learned surface and measured depth.

    Attributes:
        frames: that were held back and show the shape.
        pixels: whose ray meets the surface and that have a return.
        median_m: of the absolute distances.
        quantile_90_m: of the same; what stands before the shape counts too.
    """

    frames: int
    pixels: int
    median_m: float | None
    quantile_90_m: float | None


def held_back_times(path: Trajectory, config: LearnConfig) -> NDArray[np.int64]:
    """Stamps of the frames of a path that learning with these settings left out."""
    return np.delete(path.times_ns, select_views(len(path), config))


def held_back_errors(
    shape: ShapePrior, frames: Iterable[Frame], intrinsics: CameraIntrinsics, path: Trajectory
) -> HeldBack:
    """Compare a shape with depth images, each from where the path says that it was taken."""
    surface = as_trimesh(shape.surface())
    caster = RayCaster([Part(name="shape", mesh=surface, world_from_part=shape.reference_from_grid)])
    where = dict(zip(path.times_ns.tolist(), path.reference_from_camera, strict=True))
    found = []
    for frame in frames:
        surface_m = caster.view(intrinsics, where[frame.time_ns]).depth_m
        compared = np.isfinite(surface_m) & (frame.depth_m != NO_RETURN)
        if compared.any():
            found.append(np.abs(surface_m - frame.depth_m)[compared])
    if not found:
        return HeldBack(frames=0, pixels=0, median_m=None, quantile_90_m=None)
    apart = np.concatenate(found)
    return HeldBack(
        frames=len(found),
        pixels=len(apart),
        median_m=float(np.median(apart)),
        quantile_90_m=float(np.quantile(apart, 0.9)),
    )
