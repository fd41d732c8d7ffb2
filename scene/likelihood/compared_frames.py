"""The frames of a scene with the densities by which scenes are compared, in one world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from scene.config import ParseConfig
from scene.likelihood.colour_layers import ColourLayers, ComparedColours
from scene.likelihood.earlier_frames import earlier_depths, with_earlier
from scene.likelihood.pixel_density import PixelDensity
from scene.likelihood.unknown_surfaces import UnknownWeights
from scene.objects.scene_object import SceneObject
from scene.observation.detection import SupportPlane
from scene.observation.frame_data import SceneData


@dataclass(frozen=True, kw_only=True, eq=False)
class ComparedFrames:
    """F frames of one scene; the world is the frame of the first support, the table.

    Attributes:
        views: the frames, prepared.
        densities: of their windows, of each given those before it, of which the searched one is the first.
        camera_from_world: (F, 4, 4).
        searched: number of the frame that was searched.
        world_from_camera: (4, 4) of that frame.
        colours: of that frame and all objects, where they are compared.
        colour_weight: exponent of their factor.
    """

    views: Sequence[SceneData]
    densities: Sequence[PixelDensity]
    camera_from_world: NDArray[np.float64]
    searched: int
    world_from_camera: NDArray[np.float64]
    colours: ColourLayers | None
    colour_weight: float

    @classmethod
    def of(
        cls,
        views: Sequence[SceneData],
        searched: int,
        first_camera_from_camera: NDArray[np.float64],
        objects: Sequence[SceneObject],
        noise: DepthNoise,
        learned: UnknownWeights,
        config: ParseConfig,
    ) -> ComparedFrames:
        """Those of views; the searched one has no frame before it, the others come as they do.

        Args:
            views: the frames.
            searched: number of the one that was searched.
            first_camera_from_camera: (F, 4, 4) poses relative to the first of them.
            objects: what is looked for.
            noise: of the sensor.
            learned: how well pixels foretell each other.
            config: settings.
        """
        data = views[searched]
        camera_from_table = data.table.camera_from_table if data.table else np.eye(4)
        world_from_camera = np.asarray(np.linalg.inv(camera_from_table), np.float64)
        world_from_first = world_from_camera @ np.linalg.inv(first_camera_from_camera[searched])
        camera_from_world = np.linalg.inv(world_from_first @ first_camera_from_camera)
        windows, earlier_m = [view.window for view in views], [None] * len(views)
        if len(views) > 1:
            order = sorted(range(len(views)), key=lambda one: one != searched)
            earlier_m = earlier_depths(views, camera_from_world, order)
            learned = with_earlier(learned, [window.depth_m for window in windows], earlier_m, noise)
        error_m = config.model_error_m
        densities = [
            PixelDensity.of(window.depth_m, view.support_m, noise, error_m, window.stride, learned, told_m)
            for view, window, told_m in zip(views, windows, earlier_m, strict=True)
        ]
        return cls(
            views=views,
            densities=densities,
            camera_from_world=camera_from_world,
            searched=searched,
            world_from_camera=world_from_camera,
            colours=ColourLayers.of(data, objects, densities[searched], config.gamma),
            colour_weight=config.colour_weight,
        )

    @property
    def data(self) -> SceneData:
        """The frame that was searched."""
        return self.views[self.searched]

    @property
    def table(self) -> SupportPlane | None:
        """What the searched frame shows of it, in the world, whose frame is the table's."""
        table = self.data.table
        return replace(table, camera_from_table=np.eye(4)) if table else None

    def world_from(self, frame: int) -> NDArray[np.float64]:
        """World from the camera of a frame, (4, 4)."""
        if frame == self.searched:
            return self.world_from_camera
        return np.asarray(np.linalg.inv(self.camera_from_world[frame]), np.float64)

    def searched_from(self, frame: int) -> NDArray[np.float64]:
        """Camera of the searched frame from that of another, (4, 4)."""
        return np.asarray(self.camera_from_world[self.searched] @ self.world_from(frame), np.float64)

    def colours_of(self, objects: Sequence[SceneObject]) -> ComparedColours | None:
        """Colours as chains over these objects take them, where they are compared."""
        if self.colours is None:
            return None
        return ComparedColours(
            self.colours.of_objects(objects), jnp.float32(self.colour_weight), self.searched
        )
