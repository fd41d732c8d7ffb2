"""Several objects of one shape have names of their own."""

from scene.objects.copies import shape_of, slot_names


def test_copies_are_named_after_their_shape() -> None:
    """And lead back to it; a shape whose own name ends like a copy's stays itself."""
    assert slot_names(["mug", "can"], 2) == ["mug", "mug_2", "can", "can_2"]
    assert [shape_of(name, {"mug", "can"}) for name in slot_names(["mug", "can"], 3)] == [
        *["mug"] * 3,
        *["can"] * 3,
    ]
    assert shape_of("model_2", {"model", "model_2"}) == "model_2"
    assert shape_of("cup_2", {"mug"}) == "cup_2"
