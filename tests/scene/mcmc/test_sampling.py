"""The target of `parse` allows the scenes from which its chains start."""

import numpy as np

from scene.mcmc.sampling import prior_space
from scene.observation.detection import SupportPlane


def test_chains_start_where_objects_can_be() -> None:
    """The cuboid holds the table's own space and every start, over the table or far from it."""
    table = SupportPlane(camera_from_table=np.eye(4), half_size_m=np.array([0.4, 0.3]), bend=np.zeros(6))
    starts = np.array([[0.1, 0.2, 0.05], [1.2, -0.9, 0.8]])
    for support in (table, None):
        low, high = prior_space(support, starts)
        assert ((starts > low) & (starts < high)).all()
        none_low, none_high = prior_space(support, np.empty((0, 3)))
        assert (low <= none_low).all()
        assert (high >= none_high).all()
        assert np.isfinite([none_low, none_high]).all()
