"""What `parse --colour add` needs: frames and shapes with colours."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from pipeline.errors import PipelineError
from recordings.types import Frame

if TYPE_CHECKING:
    from pipeline.surfaces import SceneSurface
    from recordings.reading import McapRecording
    from scene.config import ParseConfig
    from scene.objects.scene_object import SceneObject

CLIPPED = 0.05
"""Share of pixels without light or with too much of it from which the user is told."""


def check_colours(
    recording: McapRecording,
    frames: Sequence[tuple[int, Frame]],
    surfaces: Mapping[str, SceneSurface],
    warn: Callable[[str], None],
) -> None:
    """Refuse frames without colour and shapes of which none has any; tell of those that lack something.

    Args:
        recording: that the frames are of.
        frames: with their numbers.
        surfaces: of the shapes, by name.
        warn: called with a sentence for the user.

    Raises:
        PipelineError: there is nothing to compare.
    """
    for number, frame in frames:
        if frame.rgb is None:
            raise PipelineError(
                f"frame {number} of {recording.decoded.bag.path} has no colour that is registered to its "
                f"depth; --colour add needs it{recording.colour_problem}"
            )
        tell_of_clipped(number, frame, warn)
    bare = [name for name, surface in surfaces.items() if surface.rgb is None]
    if len(bare) == len(surfaces):
        raise PipelineError(
            f"--colour add: none of the shapes has colours ({', '.join(bare)}); learn them from frames "
            "with colour, or take meshes with colours of vertices or textures"
        )
    if bare:
        warn(f"no colours are known of {', '.join(bare)}: any may be theirs")


def tell_of_clipped(number: int, frame: Frame, warn: Callable[[str], None]) -> None:
    """Say what share of a frame's pixels is as dark or as bright as can be stored, where it is large."""
    from scene.colour.camera_view import clipped_share

    assert frame.rgb is not None
    clipped = clipped_share(frame.rgb)
    if clipped > CLIPPED:
        warn(f"{clipped:.0%} of the pixels of frame {number} are under- or overexposed")


def coloured(
    objects: Sequence[SceneObject], surfaces: Mapping[str, SceneSurface], config: ParseConfig
) -> list[SceneObject]:
    """The objects with the colours of their surfaces, in order."""
    return [
        one.coloured(surface.vertices_m, surface.faces, surface.rgb, config.gamma)
        for one, surface in zip(objects, surfaces.values(), strict=True)
    ]
