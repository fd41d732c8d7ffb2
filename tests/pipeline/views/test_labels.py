"""Labels in the 3D view cover each other nowhere, and none is cut at an edge."""

import itertools

import numpy as np

from pipeline.views.framing import Eye
from pipeline.views.labels import Flag, _box, _covers, _is_inside, raised

EYE = Eye(np.array([0.0, -0.5, -1.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))


def flag(text: str, x_m: float, z_m: float) -> Flag:
    """Of a thing of 5 cm on the table y = 0."""
    return Flag(text=text, foot_m=np.array([x_m, 0.0, z_m]), height_m=0.05)


def test_labels_that_would_cover_each_other_rise() -> None:
    """Those farther away; one that stands alone stays as it is."""
    flags = {"near": flag("bottle 100%", 0.0, 0.0), "far": flag("marker 100%", 0.05, 0.02)}
    flags |= {"behind": flag("can 100%", 0.02, 0.05), "alone": flag("box 100%", -0.4, 0.0)}
    eye, found = raised(EYE, flags)

    assert eye is EYE
    assert list(found) == list(flags)
    assert (found["near"].height_m, found["alone"].height_m) == (0.05, 0.05)
    assert 0.05 < found["far"].height_m < found["behind"].height_m
    for one, other in itertools.combinations(found.values(), 2):
        assert not _covers(_box(eye, one), [_box(eye, other)])


def test_the_eye_goes_back_until_no_label_is_cut() -> None:
    """Looking at the same place."""
    eye, found = raised(EYE, {"long": flag("006_mustard_bottle 100%, +- 6.7 mm", 0.4, 0.0)})

    assert not _is_inside(_box(EYE, found["long"]))
    assert _is_inside(_box(eye, found["long"]))
    assert eye.target is EYE.target
