"""Pictures of shapes and parsed scenes, drawn by casting rays: no screen and no viewer needed."""

from __future__ import annotations

import io

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from pipeline.colours import object_colours
from pipeline.export.meshes import mean_colour
from pipeline.publishing.values import RunValues
from pipeline.room import RoomView
from pipeline.synthesis.world import NOTHING, Part, RayCaster
from recordings.types import CameraIntrinsics

SIDE_PX = 300
FOCAL_PX = 2.0 * SIDE_PX
SEEN_FROM = np.array([0.6, -1.0, 0.7])
"""From the front, the right and above, in a frame whose z is up."""
AMBIENT = 0.35
"""Share of light that falls on a surface seen edge-on."""
SCENE_WIDTH_PX = 640
VEIL = 0.45
"""Share of an object's colour laid over the image."""
SHAPE_COLOUR = (0.6, 0.65, 0.72)


def shape_picture(mesh: trimesh.Trimesh) -> bytes:
    """A surface (metres, z up) on white, shaded by a light at the camera."""
    middle = mesh.bounds.mean(axis=0)
    away = SEEN_FROM / np.linalg.norm(SEEN_FROM)
    half = float(np.linalg.norm(mesh.extents)) / 2
    eye = middle + away * half * FOCAL_PX / (0.45 * SIDE_PX)
    forward = -away
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    camera = CameraIntrinsics(
        width=SIDE_PX, height=SIDE_PX, fx=FOCAL_PX, fy=FOCAL_PX, cx=SIDE_PX / 2 - 0.5, cy=SIDE_PX / 2 - 0.5
    )
    view = RayCaster([Part(name="shape", mesh=mesh, world_from_part=np.eye(4))]).view(camera, pose)
    light = AMBIENT + (1 - AMBIENT) * view.cos_incidence[..., None]
    pixels = np.where(
        view.part[..., None] == NOTHING, 255.0, 255 * light * np.array(mean_colour(mesh) or SHAPE_COLOUR)
    )
    return png(pixels)


def scene_picture(values: RunValues) -> bytes | None:
    """The image that was parsed with every object found laid over it; None where the run kept no image."""
    scene, room, surfaces = values.scene, values.room, values.surfaces
    if scene is None or room is None or surfaces is None:
        return None
    kept = np.flatnonzero(room.frames == scene.frames[0])
    if not len(kept):
        return None
    background, camera = _enlarged(room, int(kept[0]))
    parts = [
        Part(
            name=str(scene.names[one]),
            mesh=trimesh.Trimesh(
                surfaces.by_name[str(scene.names[one])].vertices_m,
                surfaces.by_name[str(scene.names[one])].faces,
                process=False,
            ),
            world_from_part=scene.camera_from_object[one],
            colour=colour,
        )
        for one, colour in object_colours(scene.found).items()
    ]
    if not parts:
        return png(background)
    view = RayCaster(parts).view(camera, np.eye(4))
    colours = np.array([part.colour for part in parts])[np.maximum(view.part, 0)]
    light = AMBIENT + (1 - AMBIENT) * view.cos_incidence[..., None]
    veiled = (1 - VEIL) * background + VEIL * light * colours
    pixels = np.where(view.part[..., None] == NOTHING, background, veiled)
    edge = np.zeros(view.part.shape, np.bool_)
    edge[1:] |= view.part[1:] != view.part[:-1]
    edge[:, 1:] |= view.part[:, 1:] != view.part[:, :-1]
    return png(np.where(edge[..., None], 255.0, pixels))


def depth_pixels(depth_m: NDArray[np.floating]) -> NDArray[np.float64]:
    """A depth image (H, W) as colours (H, W, 3) 0 to 255, near bright, no return black."""
    from matplotlib import colormaps

    returns = depth_m[depth_m > 0]
    if not len(returns):
        return np.zeros((*depth_m.shape, 3))
    low, high = np.quantile(returns, [0.02, 0.98])
    share = np.clip((depth_m - low) / max(high - low, 1e-6), 0, 1)
    colours = 255 * np.asarray(colormaps["viridis_r"](share))[..., :3]
    return np.where(depth_m[..., None] > 0, colours, 0.0)


def png(pixels: NDArray[np.floating]) -> bytes:
    """Pixels (H, W, 3) 0 to 255 as a PNG file's content."""
    buffer = io.BytesIO()
    Image.fromarray(np.clip(np.rint(pixels), 0, 255).astype(np.uint8)).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def _enlarged(room: RoomView, view: int) -> tuple[NDArray[np.float64], CameraIntrinsics]:
    """A kept image (H, W, 3), colour where there is some, several times as large, and its camera."""
    small = depth_pixels(room.depth_mm[view] / 1000) if room.view_rgb is None else room.view_rgb[view]
    height, width = small.shape[:2]
    times = max(1, SCENE_WIDTH_PX // width)
    fx, fy, cx, cy = room.intrinsics.tolist()
    camera = CameraIntrinsics(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
    enlarged = np.repeat(np.repeat(np.asarray(small, np.float64), times, axis=0), times, axis=1)
    return enlarged, camera.resized(width * times, height * times)
