"""Images of a BOP data set with what is true of them: colour, depth, masks and three JSON files a scene.

https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.atomic import atomic_path, write_json
from pipeline.synthesis.visibility import Silhouette, bounding_box
from recordings.types import CameraIntrinsics, Frame

MILLIMETRES = 1000.0
LARGEST_STORED = 65535
COMPRESSION = 3
"""Of zlib: half the seconds of its default for a tenth more bytes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedObject:
    """One object in an image.

    Attributes:
        obj_id: of its model.
        camera_from_model: (4, 4) in metres.
        silhouette: its pixels if nothing hid it.
        shown: (H, W) those that the image shows.
    """

    obj_id: int
    camera_from_model: NDArray[np.float64]
    silhouette: Silhouette
    shown: NDArray[np.bool_]


def write_image(
    scene: Path,
    number: int,
    frame: Frame,
    intrinsics: CameraIntrinsics,
    camera_from_world: NDArray[np.float64],
    objects: Iterable[PosedObject],
    *,
    depth_unit_m: float,
) -> dict[str, Any]:
    """Write one image's files, each whole or not at all.

    Returns:
        Its entries of scene_camera.json (`camera`), scene_gt.json (`gt`) and scene_gt_info.json (`gt_info`).

    Raises:
        PipelineError: a file cannot be written.
    """
    name = f"{number:06d}"
    stored = np.rint(frame.depth_m / np.float64(depth_unit_m))
    stored[stored > LARGEST_STORED] = 0
    _write_png(scene / "depth" / f"{name}.png", stored.astype(np.uint16))
    if frame.rgb is not None:
        _write_png(scene / "rgb" / f"{name}.png", frame.rgb)
    truths, infos = [], []
    for index, one in enumerate(objects):
        inside = one.silhouette.in_image(intrinsics.width, intrinsics.height)
        _write_png(scene / "mask" / f"{name}_{index:06d}.png", np.where(inside, 255, 0).astype(np.uint8))
        _write_png(
            scene / "mask_visib" / f"{name}_{index:06d}.png", np.where(one.shown, 255, 0).astype(np.uint8)
        )
        truths.append({"obj_id": one.obj_id, **_pose(one.camera_from_model, "m2c")})
        infos.append(_info(one, inside, frame.depth_m > 0))
    camera = {
        "cam_K": [intrinsics.fx, 0.0, intrinsics.cx, 0.0, intrinsics.fy, intrinsics.cy, 0.0, 0.0, 1.0],
        "depth_scale": depth_unit_m * MILLIMETRES,
        **_pose(camera_from_world, "w2c"),
    }
    return {"camera": camera, "gt": truths, "gt_info": infos}


def write_scene(scene: Path, entries: Mapping[int, Mapping[str, Any]]) -> None:
    """Write a scene's JSON files from what `write_image` gave for each of its images."""
    files = {"scene_camera": "camera", "scene_gt": "gt", "scene_gt_info": "gt_info"}
    for file, key in files.items():
        write_json(scene / f"{file}.json", {str(number): entries[number][key] for number in sorted(entries)})


def targets(scene_id: int, entries: Mapping[int, Mapping[str, Any]]) -> list[dict[str, int]]:
    """The scene's part of test_targets_bop19.json: every object of every image."""
    rows = []
    for number in sorted(entries):
        ids = [int(one["obj_id"]) for one in entries[number]["gt"]]
        rows += [
            {"im_id": number, "inst_count": ids.count(one), "obj_id": one, "scene_id": scene_id}
            for one in sorted(set(ids))
        ]
    return rows


def camera_document(intrinsics: CameraIntrinsics, depth_unit_m: float) -> dict[str, float]:
    """The data set's camera.json."""
    return {
        "cx": intrinsics.cx,
        "cy": intrinsics.cy,
        "depth_scale": depth_unit_m * MILLIMETRES,
        "fx": intrinsics.fx,
        "fy": intrinsics.fy,
        "height": intrinsics.height,
        "width": intrinsics.width,
    }


def _pose(target_from_source: NDArray[np.float64], name: str) -> dict[str, list[float]]:
    return {
        f"cam_R_{name}": target_from_source[:3, :3].ravel().tolist(),
        f"cam_t_{name}": (MILLIMETRES * target_from_source[:3, 3]).tolist(),
    }


def _info(one: PosedObject, inside: NDArray[np.bool_], measured: NDArray[np.bool_]) -> dict[str, Any]:
    shown, whole = int(one.shown.sum()), one.silhouette.pixels
    return {
        "bbox_obj": list(one.silhouette.box),
        "bbox_visib": list(bounding_box(one.shown)),
        "px_count_all": whole,
        "px_count_valid": int((inside & measured).sum()),
        "px_count_visib": shown,
        "visib_fract": shown / whole if whole else 0.0,
    }


def _write_png(path: Path, pixels: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as partial:
        Image.fromarray(pixels).save(partial, compress_level=COMPRESSION)
