"""Tables of decoys hold what their kind says."""

import numpy as np
import pytest

from pipeline.synthesis.decoys import DECOY, KINDS, film_decoy
from pipeline.synthesis.objects import built_in_object
from recordings.truth import TABLE

SHAPES = {name: built_in_object(name) for name in ("box", "can", "mug")}


@pytest.mark.parametrize("number", range(2 * len(KINDS)))
def test_a_table_holds_a_decoy_and_what_is_asked_for(number: int) -> None:
    """Every other face and block lacks it; a carrier carries it; a face is larger; the same at each call."""
    table = film_decoy(SHAPES, number, 3)
    objects = {one.shape: one for one in table.recording.truth.objects}
    assert table.kind == KINDS[number % len(KINDS)]
    assert table.there == (table.kind == "carrier" or number < len(KINDS))
    assert set(objects) == {DECOY} | ({table.shape} if table.there else set())
    assert objects[DECOY].parent == TABLE
    if table.kind == "carrier":
        assert objects[table.shape].parent == DECOY
    else:
        assert table.shape == {"face": "box", "block": "can"}[table.kind]
        assert (np.sort(table.decoy.extents) >= np.sort(SHAPES[table.shape].extents) - 1e-9).all()
    again = film_decoy(SHAPES, number, 3).recording.truth.objects
    places = [one.world_from_object for one in table.recording.truth.objects]
    np.testing.assert_array_equal(places, [one.world_from_object for one in again])
