"""Several objects of one shape have names of their own."""

import numpy as np
import pytest

from scene.copies import asked_copies, copies_among, shape_of, slot_names


def test_copies_are_named_after_their_shape() -> None:
    """And lead back to it; a shape whose own name ends like a copy's stays itself."""
    assert slot_names(["mug", "can"], 2) == ["mug", "mug_2", "can", "can_2"]
    assert [shape_of(name, {"mug", "can"}) for name in slot_names(["mug", "can"], 3)] == [
        *["mug"] * 3,
        *["can"] * 3,
    ]
    assert shape_of("model_2", {"model", "model_2"}) == "model_2"
    assert shape_of("cup_2", {"mug"}) == "cup_2"


def test_copies_are_asked_for_by_number() -> None:
    """One where none is told; none or too many are refused with a line that says how many may be."""
    assert asked_copies("mug") == ("mug", 1)
    assert asked_copies("mug:3") == ("mug", 3)
    for entry in ("mug:0", "mug:-1", "mug:two", "mug:9", "mug:"):
        with pytest.raises(ValueError, match=f"'{entry}' must ask for 1 to 8 copies, such as mug:2"):
            asked_copies(entry)


def test_copies_are_told_by_their_names_and_surfaces() -> None:
    """Of mug, mug_2 and can the first two; part_1 and part_2 without a part are shapes of their own.

    So are a box and a box_2 of another size, of which two may be asked for.
    """
    one, other = np.zeros((4, 3)), np.ones((4, 3))
    pairs = [[1, 1, 0], [1, 1, 0], [0, 0, 1]]
    np.testing.assert_array_equal(copies_among({"mug": one, "mug_2": one, "can": other}), pairs)
    np.testing.assert_array_equal(copies_among({"part_1": one, "part_2": one}), np.eye(2))
    np.testing.assert_array_equal(copies_among({"box": one, "box_2": other}), np.eye(2))
    np.testing.assert_array_equal(copies_among({"box": one, "box_2": one[:3]}), np.eye(2))
    pairs = [[1, 0, 0], [0, 1, 1], [0, 1, 1]]
    np.testing.assert_array_equal(copies_among({"box": one, "box_2": other, "box_2_2": other}), pairs)
