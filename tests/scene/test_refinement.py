"""Refinement of poses: a sequential Monte Carlo sampler against known posteriors."""

import numpy as np
from scipy.spatial.transform import Rotation

from scene.refinement import PARTICLES, LogDensity, Steps, anneal

SIGMA = np.array([0.0004, 0.0009, 0.0002, 0.004, 0.010, 0.006])
"""Standard deviations of offsets (metres) and turns (radians): a tenth of what the particles begin with."""
PLAIN = Steps(line=np.zeros((2, 3)), spins_freely=False)
REPEATS = 40
CENTRES = np.array([[1.0, 0, 0, 0, 0.1, -0.2, 0.3], [0.6, 0.8, 0, 0, 0.14, -0.2, 0.3]])
"""Of two wells, 4 cm and 106 degrees apart."""


def steps_from(centre: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Offsets and turns (S, 6) from one pose."""
    before, after = (Rotation.from_quat(one[..., :4], scalar_first=True) for one in (centre, poses))
    return np.concatenate([poses[:, 4:] - centre[4:], (after * before.inv()).as_rotvec()], axis=1)


def wells(log_heights: np.ndarray) -> LogDensity:
    """Log likelihood of Gaussian wells, and an even prior."""

    def log_density(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        each = [
            height - 0.5 * ((steps_from(centre, poses) / SIGMA) ** 2).sum(axis=1)
            for centre, height in zip(CENTRES, log_heights, strict=True)
        ]
        return np.logaddexp.reduce(each, axis=0), np.zeros(len(poses))

    return log_density


def test_particles_have_the_spread_of_a_narrow_posterior(seed: int) -> None:
    """One well, from a seed three of its standard deviations off.

    The means of 40 x 128 particles that were moved together have standard errors of some hundredths of a
    standard deviation; spreads are told to a tenth.
    """
    rng = np.random.default_rng(seed)
    start = CENTRES[:1] + np.concatenate([np.zeros(4), 3 * SIGMA[:3]])
    drawn = [anneal(rng, wells(np.array([0.0, -1e3])), start, PLAIN)[0] for _ in range(REPEATS)]
    white = np.stack([steps_from(CENTRES[0], poses) / SIGMA for poses in drawn])
    assert white.shape == (REPEATS, PARTICLES, 6)
    assert np.abs(white.mean(axis=(0, 1))).max() < 0.15
    np.testing.assert_allclose(np.sqrt((white**2).mean(axis=(0, 1))), 1.0, atol=0.1)


def test_the_prior_counts_beside_the_likelihood(seed: int) -> None:
    """A likelihood and a prior of one shape, two of their standard deviations apart: half-way, and narrower.

    In standard deviations of the likelihood, within a tenth as for one well; but for the mean along the way:
    particles begin round the seed, not as the prior has them, and moves bring them three quarters of the way.
    """
    rng = np.random.default_rng(seed)
    apart = np.array([2.0, 0, 0, 0, 0, 0])

    def log_density(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        white = steps_from(CENTRES[0], poses) / SIGMA
        return -0.5 * (white**2).sum(axis=1), -0.5 * ((white - apart) ** 2).sum(axis=1)

    drawn = [anneal(rng, log_density, CENTRES[:1], PLAIN)[0] for _ in range(REPEATS)]
    white = np.stack([steps_from(CENTRES[0], poses) / SIGMA for poses in drawn])
    mean = white.mean(axis=(0, 1))
    assert 0.6 < mean[0] < 1.1
    assert np.abs(mean[1:]).max() < 0.15
    np.testing.assert_allclose(white.std(axis=(0, 1)), np.sqrt(0.5), atol=0.1)


def test_two_wells_get_their_shares(seed: int) -> None:
    """Of wells of like shape with odds 1 to 3, each with a seed.

    Four standard errors of the mean of 40 shares, as they spread: one false alarm in 16,000. One share is
    good to 0.2 only, since particles are resampled twenty times: chains put that right by their far moves.
    """
    rng = np.random.default_rng(seed)
    shares = []
    for _ in range(REPEATS):
        poses, _ = anneal(rng, wells(np.log([0.25, 0.75])), CENTRES, PLAIN)
        shares.append((poses[:, 4] < 0.12).mean())
    assert abs(np.mean(shares) - 0.25) < 4 * np.std(shares, ddof=1) / np.sqrt(REPEATS)
    assert np.std(shares) < 0.3


def test_a_rough_posterior_is_not_left_in_its_first_narrow_place(seed: int) -> None:
    """Ripples of five nats each fifth of a millimetre, under a deep well: the best is in its middle."""
    rng = np.random.default_rng(seed)

    def log_density(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        steps = steps_from(CENTRES[0], poses)
        smooth = -0.5 * ((steps / SIGMA) ** 2).sum(axis=1)
        ripples = 5 * np.cos(2 * np.pi * steps[:, :3] / 0.0002).sum(axis=1)
        return smooth + ripples, np.zeros(len(poses))

    start = CENTRES[:1] + np.concatenate([np.zeros(4), 6 * SIGMA[:3]])
    white = np.concatenate(
        [steps_from(CENTRES[0], anneal(rng, log_density, start, PLAIN)[0]) / SIGMA for _ in range(8)]
    )
    assert np.abs(white[:, :3].mean(axis=0)).max() < 0.5


def test_what_spins_freely_is_found_at_any_spin(seed: int) -> None:
    """A line's place and tilt are told, its spin is not: angles fill the circle."""
    rng = np.random.default_rng(seed)
    steps = Steps(line=np.array([[0.0, 0, 1], [0.01, 0, 0]]), spins_freely=True)

    def log_density(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        turns = Rotation.from_quat(poses[:, :4], scalar_first=True)
        off_m = poses[:, 4:] + turns.apply(steps.line[1]) - [0.1, 0.2, 0.3]
        tilt = turns.apply([0.0, 0, 1])[:, :2]
        log_likelihood = -0.5 * (off_m**2).sum(axis=1) / 0.0005**2 - 0.5 * (tilt**2).sum(axis=1) / 0.005**2
        return log_likelihood, np.zeros(len(poses))

    seed_pose = np.array([[1.0, 0, 0, 0, 0.092, 0.2, 0.3]])
    poses, log_densities = anneal(rng, log_density, seed_pose, steps)
    assert -log_densities.mean() < 5  # 2.5 expected of five directions
    turns = Rotation.from_quat(poses[:, :4], scalar_first=True)
    x, y, _ = turns.apply([1.0, 0, 0]).T
    assert np.hypot(np.cos(np.arctan2(y, x)).mean(), np.sin(np.arctan2(y, x)).mean()) < 0.6
