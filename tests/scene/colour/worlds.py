"""A small world: few pixels, two kinds, a coarse lattice that can be summed over."""

from dataclasses import replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics
from scene.colour.world import Kind, TableWorld


def small_world(side: int = 24, most: int = 2) -> TableWorld:
    """A box that is longer than wide and a smaller round thing, seen from above at a slant."""
    tall = trimesh.creation.box((0.09, 0.05, 0.06))
    disc = trimesh.creation.cylinder(0.03, 0.07, sections=16)
    sine, cosine = np.sin(0.8), np.cos(0.8)
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = [[1, 0, 0], [0, -sine, -cosine], [0, cosine, -sine]]
    camera_from_world[:3, 3] = [0, 0, 0.75]
    focal = 1.7 * side
    camera = CameraIntrinsics(
        width=side, height=side, fx=focal, fy=focal, cx=(side - 1) / 2, cy=(side - 1) / 2
    )
    kinds = (Kind.standing("box", tall), Kind.standing("disc", disc))
    return TableWorld(camera=camera, camera_from_world=camera_from_world, kinds=kinds, most=most)


def coloured_world(side: int = 72, most: int = 2) -> TableWorld:
    """Two discs of one shape and other colours, and one whose halves differ, so that its yaw is seen."""
    disc = trimesh.creation.cylinder(0.03, 0.07, sections=16)
    red, blue = np.array([0.8, 0.2, 0.15]), np.array([0.15, 0.25, 0.7])

    def kind(name: str, right: NDArray[np.float64], left: NDArray[np.float64]) -> Kind:
        colours = np.where(disc.triangles_center[:, :1] > 0, right, left)
        return Kind.standing(name, disc, colours)

    kinds = kind("red", red, red), kind("blue", blue, blue), kind("halves", red, blue)
    return replace(small_world(side, most), kinds=kinds)
