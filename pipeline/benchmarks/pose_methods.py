"""The columns of `bench poses`: our parse, registration peers, and what other programs have written."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.benchmarks.bop_results import estimates_of
from pipeline.benchmarks.learned_objects import Sought, learned_object, true_object
from pipeline.benchmarks.pose_images import PoseImage
from pipeline.evaluation.object_poses import add_s_m, model_points
from pipeline.evaluation.scenes import parents_right, region_level
from pipeline.mesh_source import MeshSource
from pipeline.peers.registration import Model, settings
from pipeline.seeds import stage_key
from pipeline.timing import Timing, timed
from scene.config import ParseConfig
from scene.objects.scene_object import SceneObject
from scene.parsing import parse_scene
from scene.result import SceneResult

Pose = NDArray[np.float64]
FEWEST_POINTS = 60
"""Fewer cannot be registered."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimated:
    """What a method says of one image.

    Attributes:
        poses: shape and camera_from_object (4, 4) of everything found, in the true meshes' frames.
        parents_right: by the object's name, where the method tells what rests on what.
        scores: by shape, where the method gives any; our presence.
        levels: by shape, of the regions of found objects' middles that the true ones are on the edge of.
        seconds: that it took, without compiling.
    """

    poses: Sequence[tuple[str, Pose]]
    scores: Mapping[str, float] = field(default_factory=dict)
    levels: Mapping[str, float] = field(default_factory=dict)
    parents_right: Mapping[str, bool] = field(default_factory=dict)
    seconds: float = 0.0


class Method(Protocol):
    """One column."""

    @property
    def title(self) -> str:
        """What it is called."""
        ...

    @property
    def setting(self) -> str:
        """That was chosen for it; empty where there is no choice."""
        ...

    def estimate(self, image: PoseImage, shapes: MeshSource) -> Estimated:
        """Poses of the image's known objects."""
        ...


@dataclass(frozen=True, kw_only=True)
class Parse:
    """Our parse of the depth image, asked for the shapes that are there, and those that the image adds.

    Attributes:
        title: of the column.
        config: of the parse.
        seed: of its random numbers.
        learned_views: look for shapes learned from so many views in place of the meshes; 0 for the meshes.
    """

    title: str
    config: ParseConfig
    seed: int = 0
    learned_views: int = 0
    setting: str = ""

    def of(self, seed: int, learned_views: int) -> Parse:
        """The same column with another seed, and shapes learned from so many views."""
        return replace(self, seed=seed, learned_views=learned_views)

    def estimate(self, image: PoseImage, shapes: MeshSource) -> Estimated:
        """Depth alone is given, no masks."""
        scene, timing = self.parsed(image, shapes, [*image.shapes, *image.absent])
        return Estimated(
            poses=self.poses(scene, shapes),
            scores=dict(zip(scene.names.tolist(), scene.presence.tolist(), strict=True)),
            levels=self._levels(scene, image, shapes),
            parents_right=parents_right(scene, image.objects) if self.config.graph == "infer" else {},
            seconds=timing.seconds,
        )

    def parsed(
        self, image: PoseImage, shapes: MeshSource, names: Sequence[str]
    ) -> tuple[SceneResult, Timing]:
        """The scene of the named shapes, and the time that it took."""
        return self.parsed_objects(image, [self._sought(shapes, name).scene_object for name in names])

    def parsed_objects(self, image: PoseImage, sought: Sequence[SceneObject]) -> tuple[SceneResult, Timing]:
        """The scene of these objects, and the time that it took."""
        with timed() as timing:
            scene = parse_scene(
                stage_key(self.seed, "parse"),
                [image.frame],
                [0],
                np.eye(4)[None],
                image.intrinsics,
                image.noise,
                sought,
                self.config,
            )
        return scene, timing

    def poses(self, scene: SceneResult, shapes: MeshSource) -> list[tuple[str, Pose]]:
        """What was found, in the true meshes' frames."""
        return [
            (name, pose @ self._sought(shapes, name).shape_from_object) for name, pose in scene.found_poses
        ]

    def _levels(self, scene: SceneResult, image: PoseImage, shapes: MeshSource) -> dict[str, float]:
        """Of what was found of the image's objects; of two of one shape nobody knows which is which."""
        found = {}
        for one in np.flatnonzero(scene.found).tolist():
            name = str(scene.names[one])
            true = [each.world_from_object for each in image.objects if each.shape == name]
            if len(true) == 1:
                sought = self._sought(shapes, name)
                camera_from_shape = (
                    image.camera_from_world @ true[0] @ np.linalg.inv(sought.shape_from_object)
                )
                found[name] = region_level(scene, one, sought.scene_object.centre_m, camera_from_shape)
        return found

    def _sought(self, shapes: MeshSource, name: str) -> Sought:
        return sought_shape(shapes, name, self.learned_views, self.seed)


@lru_cache(maxsize=256)
def sought_shape(shapes: MeshSource, name: str, views: int, seed: int) -> Sought:
    """A mesh, or what is learned of it from so many views; 0 for the mesh itself."""
    mesh = shapes.meshes[name]
    return learned_object(name, mesh, views, seed) if views else true_object(name, mesh)


@dataclass(frozen=True, kw_only=True)
class Registration:
    """A peer that registers each known object with points of the image.

    Attributes:
        title: of the column.
        peer: its name among `settings()`.
        masked: it gets the object's own points, else all over the support plane.
        setting: of `settings()[peer]`.
    """

    title: str
    peer: str
    masked: bool
    setting: str = ""

    def estimate(self, image: PoseImage, shapes: MeshSource) -> Estimated:
        """One object after another."""
        begun = time.perf_counter()
        poses = []
        for index, one in enumerate(image.objects):
            pose = self.registered(image, shapes, index)
            if pose is not None:
                poses.append((one.shape, pose))
        return Estimated(poses=poses, seconds=time.perf_counter() - begun)

    def registered(self, image: PoseImage, shapes: MeshSource, index: int) -> Pose | None:
        """camera_from_object (4, 4) of the object of that index, unless too little is seen of it."""
        points = image.points(index, masked=self.masked)
        if len(points) < FEWEST_POINTS:
            return None
        return settings()[self.peer][self.setting](_model(shapes, image.objects[index].shape), points)


@lru_cache(maxsize=256)
def _model(shapes: MeshSource, name: str) -> Model:
    return Model.of(shapes.meshes[name])


@dataclass(frozen=True, kw_only=True)
class Results:
    """Poses that another program has written as a BOP results file.

    Attributes:
        title: of the column.
        path: of the file; absolute.
    """

    title: str
    path: Path
    setting: str = ""

    def estimate(self, image: PoseImage, shapes: MeshSource) -> Estimated:
        """What the file says of the image's objects."""
        names = {number: name for name, number in shapes.ids.items()}
        found = estimates_of(self.path, image.key.scene_id, image.key.im_id)
        wanted = [one.shape for one in image.objects]
        poses = []
        for shape in dict.fromkeys(wanted):
            own = sorted((one for one in found if names[one.obj_id] == shape), key=lambda one: -one.score)
            poses += [(shape, one.camera_from_model) for one in own[: wanted.count(shape)]]
        return Estimated(poses=poses, seconds=max([one.seconds for one in found], default=0.0))


OURS = (
    Parse(title="voxscene", config=ParseConfig()),
    Parse(title="3DP3* (fixed graph)", config=ParseConfig(graph="fixed")),
)
SEARCH_SHARED = OURS[0], Parse(title="fixed graph, same search", config=ParseConfig(graph="search"))
"""The same without what else differs in 3DP3*, whose search lets nothing rest."""
PEERS = {
    "fpfh": "FPFH + RANSAC + ICP",
    "icp24": "24-start ICP",
    "ppf": "point-pair features",
}
"""Titles of the registration peers by their names in `settings()`."""


def registrations(peer: str) -> list[Registration]:
    """A peer without and with true masks, its setting still to be chosen."""
    title = PEERS[peer]
    return [
        Registration(title=title, peer=peer, masked=False),
        Registration(title=f"{title}, true masks", peer=peer, masked=True),
    ]


def registration_error_m(method: Registration, image: PoseImage, shapes: MeshSource, index: int) -> float:
    """ADD-S of what a peer finds for the object of that index."""
    one = image.objects[index]
    pose = image.camera_from_world @ one.world_from_object
    return add_s_m(_points(shapes, one.shape), pose, method.registered(image, shapes, index))


@lru_cache(maxsize=256)
def _points(shapes: MeshSource, name: str) -> NDArray[np.float64]:
    return model_points(shapes.meshes[name])
