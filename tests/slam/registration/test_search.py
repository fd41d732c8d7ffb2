"""Looking for the camera everywhere, where nothing can be found."""

from unittest.mock import Mock

import jax.numpy as jnp
import numpy as np
import pytest

from recordings.types import DepthNoise
from shapes.geometry.pose_sets import IDENTITY
from slam.keyframes.depth_view import view_of_frame
from slam.keyframes.keyframe_map import KeyframeMap
from slam.keyframes.surfels import surfel_image
from slam.registration import search
from slam.registration.search import Searcher
from tests.slam import box_room

NOISE = DepthNoise()
HERE = jnp.asarray(IDENTITY, jnp.float32)


def test_climbs_that_leave_the_numbers_find_nothing(monkeypatch: pytest.MonkeyPatch):
    """No place, and no error."""
    view = view_of_frame(box_room.frames(box_room.walk(1))[0], box_room.INTRINSICS)
    keyframe_map = KeyframeMap().with_keyframe(surfel_image(view, NOISE))
    searcher = Searcher(keyframe_map, np.asarray(HERE)[None], view, NOISE, compared=4)
    monkeypatch.setattr(search, "ascend", Mock(side_effect=lambda *given: jnp.full_like(given[-1], jnp.nan)))

    assert searcher.anywhere(HERE) == []
