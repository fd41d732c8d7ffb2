"""Objects learned from a few views, to be looked for in place of their meshes."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.benchmarks.shape_films import film_of, with_slam
from scene.objects.scene_object import SceneObject, scene_object
from shapes.learning.config import LearnConfig
from shapes.learning.distillation import learn_shape


@dataclass(frozen=True, kw_only=True, eq=False)
class Sought:
    """An object as it is looked for.

    Attributes:
        scene_object: its surface, in a frame of its own.
        shape_from_object: (4, 4) from the true mesh's frame to that one.
    """

    scene_object: SceneObject
    shape_from_object: NDArray[np.float64]


def true_object(name: str, mesh: trimesh.Trimesh) -> Sought:
    """The mesh itself."""
    one = scene_object(name, np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return Sought(scene_object=one, shape_from_object=np.eye(4))


def learned_object(name: str, mesh: trimesh.Trimesh, views: int, seed: int) -> Sought:
    """What `slam` and `learn` make of the mesh from views on two rings, on a pedestal in a room.

    Raises:
        ValueError: nothing could be learned.
        PipelineError: slam lost every frame.
    """
    film = film_of(mesh, views, seed)
    posed = with_slam(film, seed)
    shape = learn_shape(
        jax.random.key(seed),
        posed.frames,
        film.recording.intrinsics,
        posed.trajectories,
        posed.log_weights,
        LearnConfig().for_tracked_poses,
    )
    surface = shape.surface()
    return Sought(
        scene_object=scene_object(name, surface.vertices_m, np.asarray(surface.triangles, np.int64)),
        shape_from_object=np.linalg.inv(shape.reference_from_grid) @ posed.reference_from_mesh,
    )
