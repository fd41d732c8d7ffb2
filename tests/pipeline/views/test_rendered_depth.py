"""What the run knows, rendered, lies on what the camera saw."""

import numpy as np

from pipeline.publishing.values import RunValues
from pipeline.room import view_room
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.views.rendered_depth import FARTHER, NEARER, NOTHING, SAME, difference_rgb, rendered_views_mm
from slam.result import SlamResult


def test_the_map_rendered_is_what_was_seen(
    filmed_mug: SyntheticRecording, true_trajectory: SlamResult
) -> None:
    """At true poses half of the pixels agree to 5 mm, half a voxel of the map."""
    room = view_room(filmed_mug, filmed_mug.intrinsics, true_trajectory.mean)
    rendered = rendered_views_mm(RunValues(slam=true_trajectory, room=room, shapes={}), room)

    both = (rendered > 0) & (room.depth_mm > 0)
    assert both.mean() > 0.6  # small images leave most voxels with a point or none
    error = np.abs(rendered.astype(float) - room.depth_mm)[both]
    assert np.median(error) < 5
    assert np.percentile(error, 90) < 40


def test_differences_have_a_sign() -> None:
    """Blue nearer than rendered, white alike, vermilion farther, dark where one of them says nothing."""
    seen = np.array([[480, 500, 520, 0, 500]], np.uint16)
    shown = np.array([[500, 500, 500, 500, 0]], np.uint16)
    assert [tuple(one) for one in difference_rgb(seen, shown)[0].tolist()] == [
        NEARER,
        SAME,
        FARTHER,
        NOTHING,
        NOTHING,
    ]
