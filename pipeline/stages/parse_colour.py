"""`parse --colour only`: the scene that one colour image shows, no depth needed."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.simplification import few_coloured_triangles, few_triangles
from pipeline.stages.colour_input import tell_of_clipped
from recordings.types import Frame

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.session import Session
    from pipeline.surfaces import SceneSurface
    from scene.colour.world import Kind
    from scene.config import ParseConfig
    from scene.result import SceneResult

STRANGE = 0.1
"""Share of the image that fits nothing from which the user is told; silhouettes make up some hundredths."""


def parse_colour_frame(
    session: Session, shapes: Mapping[str, SceneSurface], config: ParseConfig
) -> SceneResult:
    """The scene of one colour frame.

    Args:
        session: the recording and the run folder.
        shapes: by name, each once.
        config: settings.

    Raises:
        PipelineError: there is no such frame, it has no colour, or nobody says where the table is.
    """
    import jax

    from scene.colour_parsing import parse_colour

    number, frame = _colour_frame(session, config.frames)
    assert frame.rgb is not None
    tell_of_clipped(number, frame, session.warn)
    if (frame.rgb == frame.rgb[..., :1]).all():
        session.warn(f"frame {number} is grey: its three channels count as one")
    seed = int(jax.random.randint(session.key("parse"), (), 0, 2**31 - 1))
    with session.common.progress("parse", "") as progress:
        progress.phase("searching the colour image")
        try:
            camera_from_world = _camera_over_table(session, frame, config)
            kinds = [_kind(name, one, config) for name, one in shapes.items()]
            scene, strange = parse_colour(
                seed, frame.rgb, session.recording.intrinsics, camera_from_world, kinds, number, config
            )
        except ValueError as error:
            raise PipelineError(f"{session.source.path}: {error}") from error
    if strange > STRANGE:
        session.warn(
            f"{strange:.0%} of frame {number} is neither of the table's one colour nor a thing of one "
            "colour: the result is not to be trusted"
        )
    return scene


def _kind(name: str, surface: SceneSurface, config: ParseConfig) -> Kind:
    """A shape as it stands, with its colours where they are known."""
    from scene.colour.world import Kind

    if surface.rgb is None:
        return Kind.standing(name, few_triangles(surface.vertices_m, surface.faces))
    mesh, light = few_coloured_triangles(surface.vertices_m, surface.faces, surface.rgb, config.gamma)
    return Kind.standing(name, mesh, light)


def _colour_frame(session: Session, numbers: tuple[int, ...]) -> tuple[int, Frame]:
    """The frame of this number, or the first that has colour."""
    path = session.source.path
    if numbers:
        frames = itertools.islice(enumerate(session.recording), numbers[0], numbers[0] + 1)
        found = next(frames, None)
        if found is None:
            raise PipelineError(f"{path} has no frame {numbers[0]}")
    else:
        found = next((one for one in enumerate(session.recording) if one[1].rgb is not None), None)
    if found is None or found[1].rgb is None:
        where = f"frame {numbers[0]} of {path}" if numbers else str(path)
        raise PipelineError(
            f"{where} has no colour that is registered to its frames; --colour only needs it"
            f"{session.recording.colour_problem}"
        )
    return found


def _camera_over_table(session: Session, frame: Frame, config: ParseConfig) -> NDArray[np.float64]:
    """camera_from_world (4, 4): as the user says, else as the depth shows, else as recorded.

    Raises:
        PipelineError: none of them says it.
        ValueError: the camera does not look down on the table.
    """
    from recordings.poses.recorded import recorded_pose
    from scene.colour.camera_view import camera_over_plane, camera_over_table
    from scene.observation.segmentation import scene_data, shows_enough

    if config.table:
        height_m, *angles = config.table
        return camera_over_table(height_m, *np.radians(angles))
    if shows_enough(frame.depth_m):
        seen = scene_data(frame.depth_m, session.recording.intrinsics, session.common.seed, config.support)
        if seen.table is not None:
            return camera_over_plane(seen.table.camera_from_table)
    recorded = recorded_pose(session.recording, frame.time_ns)
    if recorded is None:
        raise PipelineError(
            f"{session.source.path} shows no table and records no pose of the camera; say how the camera "
            "stands over the table with --table HEIGHT,PITCH (metres, degrees downwards)"
        )
    return camera_over_plane(np.asarray(np.linalg.inv(recorded), np.float64))
