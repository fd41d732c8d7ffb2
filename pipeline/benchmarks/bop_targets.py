"""What there is to find in a data set on disk: its images, their objects, and the file of targets.

https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

from pipeline.errors import PipelineError
from recordings.importers.bop import Annotated, annotated_frames

TARGETS = "test_targets_bop19.json"
MODELS = ("models", "models_eval")


def bop_images(root: Path, split: str) -> dict[tuple[int, int], Annotated]:
    """The annotated images by scene and number; those of the targets file, where there is one.

    Raises:
        PipelineError: the folder holds no scenes, has several cameras, or lacks an image that is a target.
        RecordingError: its annotations are malformed.
    """
    wanted = target_counts(root)
    images = {}
    for scene, folder in _scenes(root, split).items():
        if wanted and not any(one == scene for one, _ in wanted):
            continue
        for frame in annotated_frames(folder):
            if frame.objects and (not wanted or (scene, frame.number) in wanted):
                images[scene, frame.number] = frame
    missing = sorted(set(wanted) - set(images))
    if missing:
        scene, number = missing[0]
        raise PipelineError(
            f"{root} has no annotated image {number} of scene {scene}, a target of {TARGETS}; wrong --split?"
        )
    if not images:
        raise PipelineError(f"{root} has no annotated images")
    return images


@lru_cache(maxsize=4)
def target_counts(root: Path) -> Mapping[tuple[int, int], Mapping[int, int]]:
    """Instances of each object by scene and image; nothing where there is no targets file.

    Raises:
        PipelineError: the file cannot be read.
    """
    path = root / TARGETS
    if not path.is_file():
        return {}
    counts: dict[tuple[int, int], dict[int, int]] = {}
    try:
        for row in json.loads(path.read_text()):
            image = int(row["scene_id"]), int(row["im_id"])
            counts.setdefault(image, {})[int(row["obj_id"])] = int(row.get("inst_count", 1))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PipelineError(f"{path} is no file of targets ({error!r})") from error
    return counts


def models_folder(root: Path) -> Path:
    """The data set's models.

    Raises:
        PipelineError: it has none.
    """
    for name in MODELS:
        if (root / name).is_dir():
            return root / name
    raise PipelineError(f"{root} has no folder {MODELS[0]}; name one with --meshes")


def _scenes(root: Path, split: str) -> dict[int, Path]:
    """Folders of scenes by number: of the split, of the root, or the root itself."""
    if not root.is_dir():
        raise PipelineError(f"no folder {root}")
    for parent in (root / split, root):
        scenes = {
            int(path.name): path for path in parent.glob("*") if path.name.isdecimal() and path.is_dir()
        }
        if scenes:
            for path in scenes.values():
                _check_cameras(path)
            return dict(sorted(scenes.items()))
    if (root / "gt.json").is_file() or (root / "scene_camera.json").is_file():
        return {int(root.name) if root.name.isdecimal() else 0: root}
    raise PipelineError(f"{root} has neither {TARGETS} nor scenes in {split}: is it a BOP data set?")


def _check_cameras(scene: Path) -> None:
    others = sorted(path.name for path in scene.glob("scene_camera_*.json"))
    if others and not (scene / "scene_camera.json").is_file():
        raise PipelineError(f"{scene} was taken by several cameras ({', '.join(others)}); only one is read")
