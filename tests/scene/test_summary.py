"""What samples say of an object's pose."""

import numpy as np
from scipy.spatial.transform import Rotation

from scene.summary import _modes, _moments


def test_mean_and_spread_are_those_of_the_heaviest_mode(seed: int) -> None:
    """A third of the samples half a turn and 30 cm away count for nothing."""
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec([0, 0, np.pi]).as_matrix()
    samples = np.tile(turned, (150, 1, 1))
    samples[:, :3, 3] += np.random.default_rng(seed).normal(0.0, 0.002, (150, 3))
    samples[1::3] = np.eye(4)
    samples[1::3, 0, 3] = 0.3

    modes, shares = _modes(samples)
    mean, covariance = _moments(samples, modes[0])

    np.testing.assert_allclose(shares[:2], [2 / 3, 1 / 3])
    samples = np.delete(samples, np.s_[1::3], axis=0)

    np.testing.assert_allclose(mean[:3, :3], turned[:3, :3], atol=1e-12)
    np.testing.assert_allclose(mean[:3, 3], samples[:, :3, 3].mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(np.diag(covariance)[:3], samples[:, :3, 3].var(axis=0), rtol=1e-6)
