"""Tabletop scenes of a few simple things, one colour image each, as in attend, infer, repeat.

Eslami et al. 2016. Rendered by Embree, independently of the model that reads them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d
import trimesh
from manifold3d import Manifold
from numpy.typing import NDArray

from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.solids import block, cylinder, surface_of
from recordings.truth import TABLE, SceneTruth, TrueObject, write_scene_truth
from recordings.types import NO_RETURN, CameraIntrinsics, Frame
from recordings.writer import RecordingWriter
from scene.colour.density import ColourNoise, sample
from scene.colour.posterior import Scene, overlapping
from scene.colour.world import Kind, Light, TableWorld

SUBSAMPLES = 4
"""Rays along each side of a pixel: what a pixel's square integrates, silhouettes mixed."""
ELEVATION_RAD = np.radians(40.0)
DISTANCE_M = 0.75
"""Of the camera from the middle of the table."""
FOCAL_WIDTHS = 1.7
"""Focal length over image width, with which the square of the table fills the image."""
TABLE_COLOUR = (0.75, 0.72, 0.68)
BALL_M = 0.042
"""Radius of the ball; the other things are as large."""
BALL_SEGMENTS = 32
OUTLIERS = 1e-4
"""Share of channels that tell nothing: dead pixels; silhouettes are mixed beside these."""
FIRST_STAMP_NS = 1_000_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class AirScene:
    """One scene and its image.

    Attributes:
        truth: what stands there.
        albedo: (N, 3) in 0..1.
        visible: (N,) pixels, more than half of whose rays meet the thing.
        image: (H, W, 3) in 0..1, linear in light, not clipped.
    """

    truth: Scene
    albedo: NDArray[np.float64]
    visible: NDArray[np.int64]
    image: NDArray[np.float64]


def air_meshes() -> dict[str, trimesh.Trimesh]:
    """Ball, cube, cylinder and mug, about 8 cm large."""
    return {
        "ball": surface_of(Manifold.sphere(BALL_M, BALL_SEGMENTS)),
        "cube": surface_of(block(0.07, 0.07, 0.07)),
        "cylinder": surface_of(cylinder(0.085, 0.035)),
        "mug": built_in_object("mug"),
    }


def air_world(width: int = 64, height: int = 64) -> TableWorld:
    """The camera looks down at the table's middle; light and noise are the usual ones, albedos unknown."""
    focal = FOCAL_WIDTHS * width
    camera = CameraIntrinsics(
        width=width, height=height, fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2
    )
    sine, cosine = np.sin(ELEVATION_RAD), np.cos(ELEVATION_RAD)
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = [[1, 0, 0], [0, -sine, -cosine], [0, cosine, -sine]]
    camera_from_world[:3, 3] = [0, 0, DISTANCE_M]
    kinds = tuple(Kind.standing(name, mesh) for name, mesh in air_meshes().items())
    return TableWorld(camera=camera, camera_from_world=camera_from_world, kinds=kinds, light=Light())


def air_scene(world: TableWorld, seed: int) -> AirScene:
    """A draw from the world's prior, albedos within 0..1, and its image with the sensor's noise."""
    rng = np.random.default_rng([seed, 3])
    truth = _drawn(world, int(rng.integers(world.most + 1)), rng)
    albedo = rng.normal(world.noise.albedo_mean, world.noise.albedo_sd, (len(truth), 3))
    while ((albedo < 0) | (albedo > 1)).any():
        again = rng.normal(world.noise.albedo_mean, world.noise.albedo_sd, albedo.shape)
        albedo = np.where((albedo < 0) | (albedo > 1), again, albedo)
    clean, visible = photograph(world, truth, albedo)
    outliers = ColourNoise(sigma=world.noise.sigma, outlier=OUTLIERS)
    return AirScene(truth=truth, albedo=albedo, visible=visible, image=sample(rng, clean, outliers))


def _drawn(world: TableWorld, count: int, rng: np.random.Generator) -> Scene:
    """So many things by the prior: all drawn again while two overlap."""
    while True:
        places = rng.uniform(-world.half_m, world.half_m, (count, 2))
        poses = np.column_stack([places, rng.uniform(0, 2 * np.pi, count)])
        scene = Scene(rng.integers(len(world.kinds), size=count), poses)
        if not overlapping(world, scene).any():
            return scene


def write_air_scene(world: TableWorld, scene: AirScene, path: Path) -> None:
    """One frame as an MCAP file: colour in 8 bits, depth without any return, the camera's pose, the truth.

    True poses are of each mesh's own frame, as those that are found.

    Raises:
        RecordingError: the file cannot be written.
    """
    things = []
    for number, (kind, pose) in enumerate(zip(scene.truth.kinds, scene.truth.poses, strict=True)):
        shape = world.kinds[kind]
        base_from_shape = trimesh.transformations.translation_matrix(-shape.base_m)
        things.append(
            TrueObject(
                name=f"{shape.name} {number}",
                shape=shape.name,
                world_from_object=_upright(pose) @ base_from_shape,
                vertices_m=shape.vertices_m + shape.base_m,
                faces=shape.faces.astype(np.int32),
                parent=TABLE,
            )
        )
    truth = SceneTruth(objects=tuple(things), support_plane=np.array([0.0, 0.0, 1.0, 0.0]))
    rgb = np.rint(np.clip(scene.image, 0, 1) * 255).astype(np.uint8)
    nothing = np.full(rgb.shape[:2], NO_RETURN, np.float32)
    with RecordingWriter(path, world.camera) as writer:
        write_scene_truth(writer, truth, FIRST_STAMP_NS)
        writer.write_camera_pose(FIRST_STAMP_NS, np.linalg.inv(world.camera_from_world))
        writer.write_depth(Frame(time_ns=FIRST_STAMP_NS, depth_m=nothing, rgb=rgb))


def _upright(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """World from thing (4, 4) of (x, y, yaw)."""
    world_from_thing = trimesh.transformations.rotation_matrix(pose[2], [0, 0, 1])
    world_from_thing[:2, 3] = pose[:2]
    return world_from_thing


def photograph(
    world: TableWorld, scene: Scene, albedo: NDArray[np.float64], subsamples: int = SUBSAMPLES
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Noise-free image (H, W, 3) on the table, and how many pixels each thing fills by more than half.

    Args:
        world: camera, kinds and light.
        scene: the things.
        albedo: (N, 3); of a kind with known colours the gain of the light on it.
        subsamples: of a pixel, along each axis.
    """
    camera = world.camera
    fine = (np.arange(subsamples) + 0.5) / subsamples - 0.5
    columns = (np.arange(camera.width)[:, None] + fine).ravel()
    rows = (np.arange(camera.height)[:, None] + fine).ravel()
    directions = camera.rays(columns[None], rows[:, None]) @ world.camera_from_world[:3, :3]
    origin = np.broadcast_to(np.linalg.inv(world.camera_from_world)[:3, 3], directions.shape)
    caster = o3d.t.geometry.RaycastingScene(nthreads=1)
    for kind, pose in zip(scene.kinds, scene.poses, strict=True):
        points = trimesh.transform_points(world.kinds[kind].vertices_m, _upright(pose))
        corners, faces = points.astype(np.float32), world.kinds[kind].faces.astype(np.uint32)
        caster.add_triangles(o3d.core.Tensor.from_numpy(corners), o3d.core.Tensor.from_numpy(faces))
    rays = np.concatenate([origin, directions], axis=-1).astype(np.float32)
    if not len(scene):
        return np.broadcast_to(TABLE_COLOUR, (camera.height, camera.width, 3)).copy(), np.zeros(0, np.int64)
    hits = caster.cast_rays(o3d.core.Tensor.from_numpy(rays))
    thing = np.minimum(hits["geometry_ids"].numpy().astype(np.int64), len(scene))  # none is the greatest
    face, inner = hits["primitive_ids"].numpy(), hits["primitive_uvs"].numpy()
    colours = np.concatenate([albedo, [TABLE_COLOUR]])[thing]
    for one, (kind, pose) in enumerate(zip(scene.kinds, scene.poses, strict=True)):
        mine, shape = thing == one, world.kinds[kind]
        share = np.column_stack([1 - inner[mine].sum(axis=1), inner[mine]])
        normals = np.einsum("pc,pci->pi", share, shape.corner_normals[face[mine]])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        colours[mine] *= world.light.shade(normals @ _upright(pose)[:3, :3].T)[:, None]
        if shape.colours is not None:
            colours[mine] *= shape.colours[face[mine]]
    blocks = (camera.height, subsamples, camera.width, subsamples)
    filled = [(thing == one).reshape(blocks).mean(axis=(1, 3)) > 0.5 for one in range(len(scene))]
    return colours.reshape(*blocks, 3).mean(axis=(1, 3)), np.array([one.sum() for one in filled])
