"""Every number of every stage's settings has to be finite and to mean something."""

from dataclasses import fields, replace

import pytest

from pipeline.synthesis.paths import PathConfig
from pipeline.synthesis.scenarios import CameraConfig
from recordings.options import ReadOptions
from recordings.types import DepthNoise
from scene.config import ParseConfig
from shapes.learning.config import LearnConfig
from slam.config import SlamConfig

CONFIGS = (DepthNoise(), ParseConfig(), LearnConfig(), SlamConfig(), ReadOptions(), PathConfig())
NUMBERS = [
    (config, field.name)
    for config in CONFIGS
    for field in fields(config)
    if isinstance(getattr(config, field.name), float) or str(field.type).startswith("float")
]
UNBOUNDED = {"max_depth_m", "end_s"}
ANY_SIGN = {"start_deg", "degrees_per_frame"}


@pytest.mark.parametrize(("config", "name"), NUMBERS, ids=lambda one: getattr(one, "__class__", one).__name__)
def test_numbers_that_mean_nothing_are_refused(config, name):
    """NaN, both infinities, and a wrong sign; the message names the field."""
    values = [float("nan"), float("-inf")]
    values += [] if name in UNBOUNDED else [float("inf")]
    values += [] if name in ANY_SIGN else [-1.0]
    for value in values:
        with pytest.raises(ValueError, match=r"must|need|depth scale|positive|within"):
            replace(config, **{name: value})


@pytest.mark.parametrize("values", [{"max_range_m": 10, "sigma_base_m": -0.001}, {"max_range_m": 0}])
def test_a_range_in_whole_metres_is_a_number_too(values):
    """The sensor's parameters are compared with their ranges, written 10 or 10.0."""
    assert DepthNoise(max_range_m=10) == DepthNoise(max_range_m=10.0)
    with pytest.raises(ValueError, match="must lie within"):
        DepthNoise(**values)


def test_shares_of_empty_voxels_are_not_more_than_all_of_them():
    """What they leave is the share of voxels that hold nothing."""
    with pytest.raises(ValueError, match="partly_filled and walled"):
        LearnConfig(partly_filled=0.7, walled=0.5)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: SlamConfig(particles=1_000_000_000), "particles"),
        (lambda: ParseConfig(chains=1_000_000_000), "chains"),
        (lambda: ParseConfig(rounds=1_000_000_000), "rounds"),
        (lambda: LearnConfig(box=(-2.5, -2.5, -2.5, 2.5, 2.5, 2.5)), "box holds 1e"),
        (lambda: LearnConfig(box=(0.0, 0.0, 0.0, 1.0, 1.0, float("nan"))), "box must be"),
        (lambda: CameraConfig(width=0, height=0), "width"),
        (lambda: CameraConfig(width=200_000, height=200_000), "width"),
        (lambda: PathConfig(elevations_deg=(float("nan"),)), "elevations_deg"),
    ],
)
def test_what_takes_all_memory_is_refused_before_any_is_taken(make, name):
    """By its number."""
    with pytest.raises(ValueError, match=name):
        make()
