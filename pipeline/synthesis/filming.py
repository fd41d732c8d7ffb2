"""From a scene's description to a recording of it: objects put down, room built, camera led round."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.synthesis.colours import muted_colour, shape_colour
from pipeline.synthesis.furniture import clutter_piece, pedestal, table
from pipeline.synthesis.paint import painted, pattern_of
from pipeline.synthesis.paths import camera_path
from pipeline.synthesis.placement import Table, rest_on_table
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.resting import RestingObject
from pipeline.synthesis.rooms import room_parts
from pipeline.synthesis.scenarios import FilmedScene, ObjectScene, SyntheticScene, TableScene
from pipeline.synthesis.solids import surface_of
from pipeline.synthesis.visibility import pixel_counts, silhouette
from pipeline.synthesis.world import Part, RayCaster
from recordings.truth import TABLE, SceneTruth, TrueObject
from recordings.types import Trajectory

FIRST_STAMP_NS = 1_000_000_000
DRAWS = 10
"""Sets of objects drawn before a table is given up."""
CLUTTER_M = 0.09
"""Size of the things on a table that are none of the shapes."""


def film_object(shape: str, mesh: trimesh.Trimesh, scene: ObjectScene, seed: int) -> SyntheticRecording:
    """Recording of one mesh; the world's origin lies on the floor under it."""
    rng = np.random.default_rng([seed, 1])
    if scene.support == "pedestal":
        radius = 0.2 + float(mesh.extents.max())
        plate = Table(height_m=scene.height_m, radius_m=radius, spread_m=0.0)
        resting = rest_on_table([(shape, mesh)], plate, rng)[0]
        posed = object_part(resting)
        stand = surface_of(pedestal(radius, scene.height_m))
        parts = [Part(name=TABLE, mesh=stand, world_from_part=np.eye(4), colour=muted_colour(rng))]
        truth = [true_object(resting)]
    else:
        pose = trimesh.transformations.random_rotation_matrix(rng.uniform(size=3))
        pose[:3, 3] = [0, 0, scene.height_m] - pose[:3, :3] @ mesh.bounds.mean(axis=0)
        posed = Part(name=shape, mesh=mesh, world_from_part=pose, colour=shape_colour(shape))
        parts = []
        truth = [_truth(shape, shape, mesh, pose)]
    target = trimesh.transform_points(mesh.bounds.mean(axis=0)[None], posed.world_from_part)[0]
    plane_m = scene.height_m if scene.support == "pedestal" else None
    return _film(scene, [posed, *parts], truth, target, plane_m, rng, seed)


def film_table(shapes: Mapping[str, trimesh.Trimesh], scene: TableScene, seed: int) -> SyntheticRecording:
    """Recording of a table with objects drawn from named meshes; its origin lies on the floor under it.

    Raises:
        PipelineError: the objects do not fit on the table, or cannot be stacked so often.
    """
    rng = np.random.default_rng([seed, 2])
    support = Table(height_m=scene.table_height_m, radius_m=scene.table_radius_m, spread_m=scene.spread_m)
    pile = _draw_pile(shapes, scene, support, rng)
    width = 2 * scene.table_radius_m
    top = surface_of(table(width, width, scene.table_height_m))
    parts = [object_part(resting) for resting in pile]
    parts.append(Part(name=TABLE, mesh=top, world_from_part=np.eye(4), colour=muted_colour(rng)))
    parts += clutter_parts(scene.clutter, pile, support, rng)
    target = np.array([0.0, 0.0, scene.table_height_m + 0.05])
    truth = [true_object(resting) for resting in pile]
    return _film(scene, parts, truth, target, scene.table_height_m, rng, seed)


def _film(
    scene: FilmedScene,
    parts: Sequence[Part],
    objects: Sequence[TrueObject],
    target_m: NDArray[np.float64],
    support_height_m: float | None,
    rng: np.random.Generator,
    seed: int,
) -> SyntheticRecording:
    """Lead the camera round `parts`, of which the first are `objects`."""
    poses = camera_path(scene.path, target_m, rng)
    stamps = np.round(np.arange(len(poses)) / scene.path.frames_per_second * 1e9).astype(np.int64)
    trajectory = Trajectory(times_ns=stamps + FIRST_STAMP_NS, reference_from_camera=poses)
    return film_along(trajectory, scene, parts, objects, support_height_m, rng, seed)


def film_along(
    trajectory: Trajectory,
    scene: SyntheticScene,
    parts: Sequence[Part],
    objects: Sequence[TrueObject],
    support_height_m: float | None,
    rng: np.random.Generator,
    seed: int,
) -> SyntheticRecording:
    """The film of parts, of which the first are `objects`, surrounded by the scene's room.

    Args:
        trajectory: of the camera in the world.
        scene: lens, sensor, room.
        parts: what stands in the world.
        objects: the truth about the first of them.
        support_height_m: height of the top on which they stand; None where there is none.
        rng: draws the room.
        seed: of the sensor's noise.
    """
    poses = trajectory.reference_from_camera
    reach = np.linalg.norm(poses[:, :2, 3], axis=1).max()
    dressed = [_dressed(part, one, scene, seed) for part, one in zip(parts, objects, strict=False)]
    parts = [*dressed, *parts[len(dressed) :], *room_parts(scene.room, float(reach), rng)]
    intrinsics = scene.camera.intrinsics
    shown = RayCaster(parts).view(intrinsics, poses[0]).part
    visible = [
        pixel_counts(silhouette(part, intrinsics, poses[0]), shown == index).visible_fraction
        for index, part in enumerate(parts[: len(objects)])
    ]
    truth = SceneTruth(
        objects=tuple(
            replace(one, visible_fraction=share) for one, share in zip(objects, visible, strict=True)
        ),
        support_plane=None if support_height_m is None else np.array([0.0, 0.0, 1.0, -support_height_m]),
    )
    return SyntheticRecording(parts, truth, trajectory, intrinsics, scene.sensor, seed)


def _draw_pile(
    shapes: Mapping[str, trimesh.Trimesh], scene: TableScene, support: Table, rng: np.random.Generator
) -> list[RestingObject]:
    """Objects at rest, drawn again while the set that was drawn cannot be put down as asked."""
    names = sorted(shapes)
    for draw in range(DRAWS):
        rounds = [rng.permutation(names) for _ in range(scene.objects // len(names) + 1)]
        chosen = [str(name) for name in np.concatenate(rounds)[: scene.objects]]
        try:
            return rest_on_table(
                [(name, shapes[name]) for name in chosen], support, rng, stacked_share=scene.stacked_share
            )
        except PipelineError:
            if draw == DRAWS - 1 or len(names) <= scene.objects:
                raise
    raise AssertionError("unreachable")


def clutter_parts(
    count: int, pile: Sequence[RestingObject], support: Table, rng: np.random.Generator
) -> list[Part]:
    """Things of no known shape, standing apart on the table where there is room for them."""
    standing = RayCaster([object_part(resting) for resting in pile])
    parts: list[Part] = []
    for _ in range(20 * count):
        if len(parts) == count:
            break
        mesh = surface_of(clutter_piece(rng, CLUTTER_M))
        pose = trimesh.transformations.rotation_matrix(rng.uniform(0, 2 * np.pi), [0, 0, 1])
        pose[:3, 3] = *rng.normal(scale=1.3 * support.spread_m, size=2), support.height_m
        centre = trimesh.transform_points(mesh.bounds.mean(axis=0)[None], pose)
        room = float(np.linalg.norm(mesh.extents)) / 2
        apart = standing.clearance_m(centre)[0] > room
        apart &= all(np.linalg.norm(centre - other.world_from_part[:3, 3]) > 2 * CLUTTER_M for other in parts)
        if apart and np.linalg.norm(centre[0, :2]) + room < support.radius_m:
            name = f"clutter {len(parts)}"
            parts.append(Part(name=name, mesh=mesh, world_from_part=pose, colour=muted_colour(rng)))
    return parts


def object_part(resting: RestingObject) -> Part:
    """The object's surface in the world, in its shape's colour."""
    return Part(
        name=resting.name,
        mesh=resting.mesh,
        world_from_part=resting.world_from_object,
        colour=shape_colour(resting.shape),
    )


def _dressed(part: Part, one: TrueObject, scene: SyntheticScene, seed: int) -> Part:
    """An object's surface in the colours that the scene asks for."""
    if scene.colours == "random":
        return replace(part, colour=shape_colour(f"{one.name} {seed}"))
    if scene.colours == "painted":
        return replace(part, mesh=painted(one.shape, part.mesh, pattern_of(one.shape)))
    return part


def true_object(resting: RestingObject) -> TrueObject:
    """What the truth says of an object at rest; nothing has been seen of it yet."""
    return replace(
        _truth(resting.name, resting.shape, resting.mesh, resting.world_from_object),
        parent=resting.parent,
        contact_faces=resting.contact_faces,
    )


def _truth(name: str, shape: str, mesh: trimesh.Trimesh, pose: NDArray[np.float64]) -> TrueObject:
    """A floating object of which nothing has been seen yet."""
    return TrueObject(
        name=name,
        shape=shape,
        world_from_object=pose,
        vertices_m=np.asarray(mesh.vertices, np.float64),
        faces=np.asarray(mesh.faces, np.int32),
        parent=None,
        contact_faces=None,
        visible_fraction=0.0,
    )
