"""Where the images of `bench poses` come from: synthetic tables, challenging images, or a data set on disk.

A source is a few numbers and paths, so that any process makes or reads the same images.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import trimesh

from pipeline.benchmarks.bop_targets import bop_images, target_counts
from pipeline.benchmarks.pose_images import ImageKey, PoseImage
from pipeline.config import plain_values
from pipeline.mesh_source import MeshSource
from pipeline.synthesis.challenging_scene import ChallengingScene
from pipeline.synthesis.challenging_set import ChallengingSet, scene_id
from pipeline.synthesis.filming import film_table
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import TableScene
from pipeline.synthesis.worlds import WorldScene, film_world
from recordings.importers.bop import Annotated, scene_truth
from recordings.importers.dataset import read_frame
from recordings.types import DepthNoise

STACKED_SHARE = 1 / 3


class PoseSource(Protocol):
    """Images with known objects."""

    @property
    def shapes(self) -> MeshSource:
        """The objects."""
        ...

    def places(self) -> list[ImageKey]:
        """Places of all images."""
        ...

    def image(self, key: ImageKey) -> PoseImage:
        """The image at a place."""
        ...

    def about(self) -> dict[str, Any]:
        """Everything that decides what an image at a place is, as plain values."""
        ...


@dataclass(frozen=True, kw_only=True)
class Tables:
    """Synthetic tables, a third of whose objects are stacked where there are three.

    Attributes:
        shapes: from which they are drawn.
        objects: on each.
        seed: of the first.
        numbers: of the tables.
    """

    shapes: MeshSource
    objects: int
    seed: int
    numbers: tuple[int, ...]

    def places(self) -> list[ImageKey]:
        """One a table."""
        return [ImageKey("table", 0, number) for number in self.numbers]

    def image(self, key: ImageKey) -> PoseImage:
        """The table of a number, the same at each call."""
        stacked_share = STACKED_SHARE if self.objects >= 1 / STACKED_SHARE else 0.0
        scene = TableScene(objects=self.objects, stacked_share=stacked_share, room=RoomConfig(kind="none"))
        return filmed_image(
            key, film_table(self.shapes.meshes, scene, self.seed + key.im_id), self.shapes.meshes
        )

    def about(self) -> dict[str, Any]:
        """Objects, their number, and the seed."""
        return {"tables": self.objects, "seed": self.seed, "shapes": self.shapes.hashes}


@dataclass(frozen=True, kw_only=True)
class ChallengingImages:
    """The images that `synth challenging` writes, made in memory.

    Attributes:
        made_of: the set.
    """

    made_of: ChallengingSet

    @property
    def shapes(self) -> MeshSource:
        """Those that are put down."""
        return self.made_of.shapes

    def places(self) -> list[ImageKey]:
        """Of every kind, so many."""
        kinds, count = self.made_of.kinds, self.made_of.images
        return [ImageKey(kind, scene_id(kind), number) for kind in kinds for number in range(count)]

    def image(self, key: ImageKey) -> PoseImage:
        """The image of that kind and number."""
        image = filmed_image(key, self.made_of.image(key.kind, key.im_id).recording, self.shapes.meshes)
        sensor, usual = self.made_of.scene.sensor.noise, DepthNoise()
        told = replace(usual, sigma_base_m=sensor.sigma_base_m, sigma_growth_per_m=sensor.sigma_growth_per_m)
        return replace(image, noise=told)

    def about(self) -> dict[str, Any]:
        """The set's fingerprint."""
        return {"challenging": self.made_of.fingerprint}


@dataclass(frozen=True, kw_only=True)
class Worlds:
    """Synthetic worlds like the real ones, with things that nobody asks for and shapes that are not there.

    Attributes:
        shapes: that may be asked for.
        others: meshes of things that nobody asks for; None leaves clutter alone.
        scene: what a world consists of.
        seed: of the first.
        numbers: of the worlds.
    """

    shapes: MeshSource
    others: MeshSource | None
    scene: WorldScene
    seed: int
    numbers: tuple[int, ...]

    def places(self) -> list[ImageKey]:
        """One a world."""
        return [ImageKey("world", 0, number) for number in self.numbers]

    def image(self, key: ImageKey) -> PoseImage:
        """The world of a number."""
        others = self.others.meshes if self.others else {}
        world = film_world(self.shapes.meshes, others, self.scene, self.seed + key.im_id)
        return replace(filmed_image(key, world.recording, self.shapes.meshes), absent=world.absent)

    def about(self) -> dict[str, Any]:
        """Objects, others, settings and the seed."""
        others = self.others.hashes if self.others else {}
        settings = plain_values(self.scene)
        return {"worlds": settings, "seed": self.seed, "shapes": self.shapes.hashes, "others": others}


@dataclass(frozen=True, kw_only=True)
class BopImages:
    """A BOP data set, or one folder of YCB-Video frames.

    Attributes:
        root: of the data set; absolute.
        split: folder of its scenes.
        shapes: its models, in their own frames.
    """

    root: Path
    split: str
    shapes: MeshSource

    def places(self) -> list[ImageKey]:
        """The images of the targets file, or all that there are where there is none."""
        return sorted(
            {ImageKey(self.root.name, scene, image) for scene, image in _images(self.root, self.split)}
        )

    def image(self, key: ImageKey) -> PoseImage:
        """The image with those of its objects that are targets."""
        annotated = _images(self.root, self.split)[key.scene_id, key.im_id]
        truth, _ = scene_truth([(annotated, np.eye(4))])
        wanted = target_counts(self.root).get((key.scene_id, key.im_id))
        frame, intrinsics = read_frame(annotated.files, annotated.intrinsics, annotated.depth_unit_m)
        ids = dict(annotated.object_ids)
        objects = [one for one in truth.objects if wanted is None or ids[one.shape] in wanted]
        return PoseImage(
            key=key,
            frame=frame,
            intrinsics=intrinsics,
            truth=type(truth)(objects=tuple(objects)),
            camera_from_world=np.eye(4),
            meshes=self.shapes.meshes,
        )

    def about(self) -> dict[str, Any]:
        """Where it is; its files are taken not to change."""
        return {"data": str(self.root), "split": self.split, "shapes": self.shapes.hashes}


@lru_cache(maxsize=2)
def _images(root: Path, split: str) -> dict[tuple[int, int], Annotated]:
    return bop_images(root, split)


def filmed_image(
    key: ImageKey, recording: SyntheticRecording, meshes: Mapping[str, trimesh.Trimesh]
) -> PoseImage:
    """The first frame of a film."""
    return PoseImage(
        key=key,
        frame=recording.frame(0),
        intrinsics=recording.intrinsics,
        truth=recording.truth,
        camera_from_world=np.linalg.inv(recording.trajectory.reference_from_camera[0]),
        meshes=meshes,
    )


def challenging_images(
    shapes: MeshSource, kinds: tuple[str, ...], count: int, scene: ChallengingScene, seed: int
) -> ChallengingImages:
    """So many challenging images of each kind."""
    return ChallengingImages(
        made_of=ChallengingSet(kinds=kinds, images=count, scene=scene, shapes=shapes, seed=seed)
    )
