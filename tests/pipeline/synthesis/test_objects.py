"""The built-in objects are solids of everyday size."""

import numpy as np
import pytest

from pipeline.synthesis.objects import built_in_names, built_in_object


def test_there_are_at_least_eight() -> None:
    """Those of the plan are among them."""
    assert {"box", "can", "mug", "bowl", "bottle", "clamp", "bracket", "marker"} <= set(built_in_names())


@pytest.mark.parametrize("name", built_in_names())
def test_each_is_a_watertight_solid_in_one_piece_centred_on_the_origin(name: str) -> None:
    """A closed, outward surface with a volume, 1 to 30 cm in size."""
    mesh = built_in_object(name)

    assert mesh.is_volume
    assert mesh.body_count == 1
    assert mesh.volume > 1e-6
    np.testing.assert_allclose(mesh.bounds.sum(axis=0), 0, atol=1e-12)
    assert (mesh.extents > 0.01).all()
    assert (mesh.extents < 0.3).all()


def test_the_mug_has_a_handle_and_a_hollow() -> None:
    """One hole through it, and half of its hull is empty."""
    mug = built_in_object("mug")

    assert mug.euler_number == 0
    assert mug.volume < 0.5 * mug.convex_hull.volume
