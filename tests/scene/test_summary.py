"""What samples say of an object's pose."""

import numpy as np
from scipy.spatial.transform import Rotation

from scene.summary import _moments


def test_spread_is_that_of_the_mode_where_the_chains_are(seed: int) -> None:
    """All samples half a turn from the best scene: their own mean and their own spread, not zero."""
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec([0, 0, np.pi]).as_matrix()
    samples = np.tile(turned, (100, 1, 1))
    samples[:, :3, 3] += np.random.default_rng(seed).normal(0.0, 0.002, (100, 3))

    mean, covariance = _moments(samples, np.eye(4), samples[0])

    np.testing.assert_allclose(mean[:3, :3], turned[:3, :3], atol=1e-12)
    np.testing.assert_allclose(mean[:3, 3], samples[:, :3, 3].mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(np.diag(covariance)[:3], samples[:, :3, 3].var(axis=0), rtol=1e-6)
