"""The pattern search for solids comes to the top of a density whose coordinates hang together."""

import numpy as np
from scipy.spatial.transform import Rotation

from scene.presence.gaussian_fits import climbed, face_factors, fitted, reshaped

TRUTH = np.array([1.0, 0, 0, 0, 0.1, -0.2, 0.8, *np.log([0.05, 0.08, 0.12])])


def log_density_of_faces(states: np.ndarray) -> np.ndarray:
    """Gaussian in the places of the six faces, 2 mm, and in the turn, 0.02: place and size hang together."""
    half_m, middle_m = np.exp(states[..., 7:]), states[..., 4:7]
    faces = np.concatenate([middle_m + half_m, middle_m - half_m], axis=-1)
    wanted = np.concatenate([TRUTH[4:7] + np.exp(TRUTH[7:]), TRUTH[4:7] - np.exp(TRUTH[7:])])
    turns = Rotation.from_quat(states[..., :4].reshape(-1, 4), scalar_first=True).magnitude()
    off = ((faces - wanted) / 0.002) ** 2
    return -0.5 * off.sum(axis=-1) - 0.5 * (turns.reshape(off.shape[:-1]) / 0.02) ** 2


def test_faces_come_to_where_they_are_densest(seed: int) -> None:
    """From 3 cm and 0.15 rad off each face ends within its 2 mm; twenty starts."""
    rng = np.random.default_rng(seed)
    steps = np.concatenate([rng.normal(0, 0.03, (1, 20, 6)), rng.normal(0, 0.15, (1, 20, 3))], axis=-1)
    starts = reshaped(TRUTH[None], steps)[0]
    found = climbed(log_density_of_faces, starts, np.repeat([0.02, 0.2], [6, 3]), 25)

    assert (log_density_of_faces(found[:, None]) > -0.5 * 9).all()


def log_density_of_solid(states: np.ndarray) -> np.ndarray:
    """That of the faces, in Lebesgue measure of place, turn on the right and logs of sizes.

    The faces' own measure changes by 2 x size for each axis.
    """
    return log_density_of_faces(states) + (np.log(2) + states[..., 7:]).sum(axis=-1)


def test_curvature_and_fits_tell_the_mass_of_a_gaussian(seed: int) -> None:
    """Six faces of 2 mm and three turns of 0.02: log of (2 pi)^(9/2) x their product, within 0.25.

    Twelve fits of 96 draws: their mean has a standard error of 0.04 where a third of the draws count.
    """
    rng = np.random.default_rng(seed)
    centres = np.tile(TRUTH, (12, 1))
    factors = face_factors(log_density_of_solid, centres)
    fits = fitted(rng, log_density_of_solid, centres, factors, np.full(9, 1e-5), 2, 48)

    exact = 4.5 * np.log(2 * np.pi) + 6 * np.log(0.002) + 3 * np.log(0.02)
    assert abs(fits.log_masses.mean() - exact) < 0.25
    assert fits.log_masses.std() < 1
    found = np.sqrt((factors @ np.swapaxes(factors, 1, 2))[0, :3, :3].diagonal())
    np.testing.assert_allclose(found, 0.002 / np.sqrt(2), rtol=0.1)


def test_a_moved_face_leaves_the_others() -> None:
    """The face +y goes 1 cm out: its opposite, and all others, stay."""
    steps = np.zeros((1, 1, 9))
    steps[0, 0, 2] = 0.01
    moved = reshaped(TRUTH[None], steps)[0, 0]

    np.testing.assert_allclose(np.exp(moved[7:]), [0.05, 0.085, 0.12], atol=1e-12)
    np.testing.assert_allclose(moved[4:7], [0.1, -0.195, 0.8], atol=1e-12)
