"""A set of challenging images on disk: a BOP data set, and one recording an image.

Every image is a task of its own, made from its numbers alone; its entry is written last, so that whatever
has an entry is whole, and an interrupted set goes on where it stopped.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from pipeline.atomic import atomic_path, write_json
from pipeline.config import plain_values
from pipeline.errors import PipelineError
from pipeline.export.bop import model_info
from pipeline.export.bop_images import PosedObject, camera_document, targets, write_image, write_scene
from pipeline.export.meshes import mesh_bytes, moved
from pipeline.fingerprints import PROGRAM, canonical_hash, source_hash
from pipeline.jax_setup import set_up_jax
from pipeline.mesh_source import MeshSource
from pipeline.synthesis.challenging import ChallengingImage, challenging_image, unplaceable
from pipeline.synthesis.challenging_kinds import KINDS
from pipeline.synthesis.challenging_scene import DEPTH_UNIT_M, ChallengingScene
from pipeline.synthesis.visibility import silhouette
from pipeline.synthesis.writing import write_recording
from pipeline.task_engine import Executors, Task, run_tasks
from recordings.dataset_numbers import DatasetNumbers

SPLIT = "test"
MANIFEST = "challenging.json"
OWN = (SPLIT, "models", "recordings", "camera.json", "test_targets_bop19.json", MANIFEST)
"""What a set consists of."""
FEWEST_SHAPES = 2
"""That a kind with neighbours needs."""


@dataclass(frozen=True, kw_only=True)
class ChallengingSet:
    """What a set is made of.

    Attributes:
        kinds: of its images.
        images: of each kind.
        scene: how they are taken.
        shapes: what is put down.
        seed: of the set.
    """

    kinds: tuple[str, ...]
    images: int
    scene: ChallengingScene
    shapes: MeshSource
    seed: int

    @property
    def fingerprint(self) -> str:
        """Of everything that decides an image besides its kind and number."""
        version = source_hash(challenging_image.__module__, within=PROGRAM)
        return canonical_hash([version, plain_values(self.scene), self.shapes.hashes, self.seed])

    def image(self, kind: str, number: int) -> ChallengingImage:
        """The image of that number, the same wherever it is made; every shape is the target equally often.

        Raises:
            PipelineError: no placement of those tried gave what the kind wants.
        """
        names = _targets(self.shapes, kind, self.scene)
        which = list(KINDS).index(kind)
        turn = np.random.default_rng([self.seed, which]).permutation(len(names))[number % len(names)]
        seed = (self.seed, which, number)
        return challenging_image(self.shapes.meshes, kind, names[turn], self.scene, seed)

    def refused(self, kind: str) -> dict[str, str]:
        """Shapes that this kind cannot have as a target, with the reason."""
        return dict(_refusals(self.shapes, kind, self.scene))


def scene_id(kind: str) -> int:
    """BOP's number of the scene that holds a kind's images."""
    return list(KINDS).index(kind) + 1


def write_set(
    wanted: ChallengingSet,
    out: Path,
    executors: Executors,
    at_once: int,
    progress: Callable[[int, int], None],
    *,
    force: bool = False,
) -> list[str]:
    """Write a set, or what is missing of it.

    Args:
        wanted: what it is made of.
        out: its folder.
        executors: where images are made.
        at_once: so many of them.
        progress: is told images done and in all.
        force: a set made of something else is replaced.

    Returns:
        Sentences on shapes that were left out.

    Raises:
        PipelineError: an image cannot be made or written, or the folder holds another set.
    """
    _begin(wanted, out, force=force)
    remarks = _checked_shapes(wanted)
    _write_models(wanted.shapes, out / "models")
    names = [(kind, number) for kind in wanted.kinds for number in range(wanted.images)]
    missing = [(kind, number) for kind, number in names if not _entry_path(out, kind, number).is_file()]
    progress(len(names) - len(missing), len(names))
    tasks = [
        Task(name=f"{kind} {number}", call=_make_image, arguments=(wanted, out, kind, number))
        for kind, number in missing
    ]
    for done, outcome in enumerate(run_tasks(tasks, executors, at_once), start=1):
        if outcome.error is not None:
            raise PipelineError(f"image {outcome.task.name}: {outcome.error}") from outcome.error
        progress(len(names) - len(missing) + done, len(names))
    _finish(wanted, out)
    return remarks


def _make_image(wanted: ChallengingSet, out: Path, kind: str, number: int) -> None:
    """Make and write one image in both formats, its entry last; a worker sets JAX up for it."""
    set_up_jax()
    image = wanted.image(kind, number)
    recording = image.recording
    frame, pose = recording.frame(0), recording.trajectory.reference_from_camera[0]
    camera_from_world = np.linalg.inv(pose)
    shown = recording.ideal_view(0).part
    objects = [
        PosedObject(
            obj_id=wanted.shapes.ids[one.shape],
            camera_from_model=camera_from_world @ one.world_from_object,
            silhouette=silhouette(image.parts[index], recording.intrinsics, pose),
            shown=shown == index,
        )
        for index, one in enumerate(recording.truth.objects)
    ]
    scene = out / SPLIT / f"{scene_id(kind):06d}"
    entry = write_image(
        scene, number, frame, recording.intrinsics, camera_from_world, objects, depth_unit_m=DEPTH_UNIT_M
    )
    path = out / "recordings" / kind / f"{number:06d}.mcap"
    path.parent.mkdir(parents=True, exist_ok=True)
    numbers = DatasetNumbers(
        scene_id=scene_id(kind), image_ids={frame.time_ns: number}, object_ids=wanted.shapes.ids
    )
    write_recording(recording, path, numbers=numbers, mends=True)
    entry |= {"kind": kind, "target": image.target, "names": [one.name for one in recording.truth.objects]}
    _entry_path(out, kind, number).parent.mkdir(parents=True, exist_ok=True)
    write_json(_entry_path(out, kind, number), entry)


def _begin(wanted: ChallengingSet, out: Path, *, force: bool) -> None:
    """Make the folder a set of this fingerprint."""
    manifest = out / MANIFEST
    if manifest.is_file() and not force and _fingerprint_of(manifest) != wanted.fingerprint:
        raise PipelineError(
            f"{out} holds images made with other settings, meshes or version; --force replaces them"
        )
    if out.is_dir() and not manifest.is_file() and any(out.iterdir()) and not force:
        raise PipelineError(f"{out} holds something else; name another folder, or --force to write into it")
    if not manifest.is_file() or _fingerprint_of(manifest) != wanted.fingerprint:
        for name in OWN:
            path = out / name
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    (out / "models").mkdir(parents=True, exist_ok=True)
    write_json(
        manifest,
        {
            "fingerprint": wanted.fingerprint,
            "kinds": {kind: {"scene_id": scene_id(kind), "images": wanted.images} for kind in wanted.kinds},
            "seed": wanted.seed,
            "settings": plain_values(wanted.scene),
            "objects": wanted.shapes.ids,
        },
    )


def _fingerprint_of(manifest: Path) -> str | None:
    try:
        return json.loads(manifest.read_text()).get("fingerprint")
    except (ValueError, AttributeError):
        return None


def _checked_shapes(wanted: ChallengingSet) -> list[str]:
    """Remarks on shapes that cannot be the target of a kind.

    Raises:
        PipelineError: too few are left.
    """
    remarks = []
    for kind in wanted.kinds:
        wanted.scene.limits(kind)
        refused = wanted.refused(kind)
        remarks += [f"{name} {why}, so it is no target of {kind} images" for name, why in refused.items()]
        needed = FEWEST_SHAPES if kind in {"stacked", "occluded"} else 1
        if len(wanted.shapes.meshes) < needed or len(refused) == len(wanted.shapes.meshes):
            raise PipelineError(f"no {kind} images can be made of these meshes; leave {kind} out of --kinds")
    return remarks


def _finish(wanted: ChallengingSet, out: Path) -> None:
    """Write what stands once a scene, and once a set."""
    rows = []
    for kind in wanted.kinds:
        entries = {
            number: json.loads(_entry_path(out, kind, number).read_text()) for number in range(wanted.images)
        }
        write_scene(out / SPLIT / f"{scene_id(kind):06d}", entries)
        rows += targets(scene_id(kind), entries)
    write_json(out / "camera.json", camera_document(wanted.scene.camera.intrinsics, DEPTH_UNIT_M))
    write_json(out / "test_targets_bop19.json", sorted(rows, key=lambda row: (row["scene_id"], row["im_id"])))


def _entry_path(out: Path, kind: str, number: int) -> Path:
    return out / SPLIT / f"{scene_id(kind):06d}" / "entries" / f"{number:06d}.json"


def _write_models(shapes: MeshSource, folder: Path) -> None:
    """The shapes in millimetres in their own frames, so that poses are those of the truth."""
    info = {}
    for name, mesh in shapes.meshes.items():
        model = moved(mesh, np.eye(4), "mm")
        number = shapes.ids[name]
        with atomic_path(folder / f"obj_{number:06d}.ply") as partial:
            partial.write_bytes(mesh_bytes(model, "ply"))
        info[str(number)] = model_info(np.asarray(model.vertices))
    write_json(folder / "models_info.json", dict(sorted(info.items(), key=lambda one: int(one[0]))))


@lru_cache(maxsize=16)
def _refusals(shapes: MeshSource, kind: str, scene: ChallengingScene) -> Mapping[str, str]:
    return unplaceable(shapes.meshes, kind, scene)


def _targets(shapes: MeshSource, kind: str, scene: ChallengingScene) -> list[str]:
    """Names of the shapes that can be the target of a kind."""
    refused = _refusals(shapes, kind, scene)
    return [name for name in sorted(shapes.meshes) if name not in refused]
