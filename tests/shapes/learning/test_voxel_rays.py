"""Rays made of readings: what one view says of voxels side by side, before, on and behind a surface."""

import jax.numpy as jnp
import numpy as np

from recordings.types import DepthNoise
from shapes.learning.config import LearnConfig
from shapes.learning.expectation_propagation import voxel_states
from shapes.learning.view_readings import ViewReadings
from shapes.learning.voxel_rays import evidence, wall_normals
from shapes.voxel_grid import VoxelGrid

OPACITY = np.asarray([[1.0, 0.0], [1.0, 0.0]])
SIGMA_M = 0.0006


def occupied_after_one_view(behind_m: list[float], config: LearnConfig | None = None) -> np.ndarray:
    """Probabilities of voxels of 5 mm in one bundle of rays, 0.5 a priori."""
    count = len(behind_m)
    grid = VoxelGrid(shape=(count, 1, 1), pitch_m=0.005, reference_from_grid=np.eye(4), on_plane=False)
    behind = np.asarray(behind_m, np.float32)
    nowhere = np.zeros(count, np.bool_)
    readings = {
        "behind_m": np.stack([behind, np.full(count, -np.inf)], axis=1),
        "sigma_m": np.full((count, 2), SIGMA_M),
        "association": np.tile([1.0, 0.0], (count, 1)),
        "normal": np.tile([0.0, 0.0, -1.0], (count, 1)),
        "column": np.zeros(count, np.float32),
        "row": np.zeros(count, np.float32),
        "depth_m": 0.8 + behind,
        "plane_depth_m": np.full(count, np.inf),
    }
    view = ViewReadings.of(
        nowhere,
        nowhere,
        np.arange(count),
        readings,
        grid,
        eye_m=np.asarray([0.0, 0.0, -0.8]),
        footprint=4.0,
    )
    found = evidence([view], wall_normals([view], grid), grid, OPACITY, config or LearnConfig())
    log_prior = jnp.asarray(np.log(0.5) + found.log_crossings)
    states = voxel_states(found.rays, log_prior, jnp.asarray(OPACITY), sweeps=60, damping=0.3)
    return np.asarray(states.probability[:, 0])


def test_voxels_side_by_side_do_not_hide_each_other() -> None:
    """Two centres just under one surface are both occupied; one behind them keeps its prior."""
    first, second, hidden = occupied_after_one_view([0.0014, 0.0016, 0.0115])
    assert min(first, second) > 0.95
    assert abs(hidden - 0.5) < 0.02


def test_one_after_the_other_the_first_that_is_behind_the_surface_ends_the_ray() -> None:
    """The centre before the surface is free, although the ray may well end at the next."""
    before, behind = occupied_after_one_view([-0.0012, 0.0038])
    assert before < 0.05
    assert behind > 0.95


def test_a_part_of_a_ray_may_end_before_it_or_go_on_beyond() -> None:
    """A lone voxel is free before the surface, occupied just behind it, unknown far behind it."""
    before, behind, far = (occupied_after_one_view([one])[0] for one in (-0.0012, 0.0012, 0.0090))
    assert before < 0.05
    assert behind > 0.95
    assert abs(far - 0.5) < 0.02


def test_where_no_reading_is_unexplained_voxels_have_probabilities() -> None:
    """Of a sensor without outliers and surfaces that voxels stand for: before, just behind and far behind."""
    certain = LearnConfig(unresolved=0.0, noise=DepthNoise(outlier_probability=0.0))

    before, behind, far = occupied_after_one_view([-0.0062, 0.0012, 0.0090], certain)

    assert before < 1e-6
    assert behind > 0.95
    assert abs(far - 0.5) < 0.02
