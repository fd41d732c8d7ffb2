"""Cameras go where their configuration says and look at their target."""

import numpy as np
import pytest

from pipeline.synthesis.paths import PathConfig, camera_path

TARGET_M = np.array([0.2, -0.1, 0.9])


def path(seed: int = 0, **settings: object) -> np.ndarray:
    """A path of the given settings round the target."""
    return camera_path(PathConfig(**settings), TARGET_M, np.random.default_rng(seed))  # type: ignore[arg-type]


def angles_deg(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angles (N,) between unit vectors (N, 3)."""
    return np.degrees(np.arccos(np.clip((first * second).sum(axis=-1), -1, 1)))


@pytest.mark.parametrize("kind", ["orbit", "handheld", "rings"])
def test_poses_are_rigid_and_upright(kind: str) -> None:
    """Orthonormal, right-handed, the image's down axis points down."""
    poses = path(kind=kind, frames=40, elevations_deg=(20.0, 50.0))
    rotation = poses[:, :3, :3]

    assert len(poses) == 40
    np.testing.assert_allclose(
        rotation @ rotation.swapaxes(-1, -2), np.tile(np.eye(3), (40, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1)
    assert (rotation[:, 2, 1] < 0).all()


def test_an_orbit_steps_evenly_at_one_distance_and_looks_at_the_target() -> None:
    """Azimuth grows by the set step; the target stays on the optical axis."""
    poses = path(frames=10, degrees_per_frame=12.0, radius_m=1.3, elevations_deg=(35.0,), start_deg=0.0)
    arm = poses[:, :3, 3] - TARGET_M

    np.testing.assert_allclose(np.linalg.norm(arm, axis=1), 1.3)
    np.testing.assert_allclose(
        np.degrees(np.arctan2(arm[:, 1], arm[:, 0])) % 360, np.arange(10) * 12.0, atol=1e-9
    )
    np.testing.assert_allclose(np.degrees(np.arcsin(arm[:, 2] / 1.3)), 35.0)
    np.testing.assert_allclose(poses[:, :3, 2], -arm / 1.3, atol=1e-12)


def test_uneven_steps_differ_by_no_more_than_is_asked_and_close_the_circle() -> None:
    """Twelve steps of 30 degrees on average, the one back to the start included; some are far from it."""
    poses = path(kind="orbit", frames=12, degrees_per_frame=30.0, uneven=0.3, elevations_deg=(0.0,))

    outward = (poses[:, :3, 3] - TARGET_M) / np.linalg.norm(poses[:, :3, 3] - TARGET_M, axis=1)[:, None]
    steps = angles_deg(outward, np.roll(outward, -1, axis=0))
    assert steps.sum() == pytest.approx(360.0)
    assert 30 * 0.7 / 1.3 <= steps.min() < 27
    assert 33 < steps.max() <= 30 * 1.3 / 0.7


def test_an_orbit_passes_through_its_elevations() -> None:
    """Evenly, from the first frame to the last."""
    poses = path(frames=9, elevations_deg=(20.0, 60.0, 40.0), radius_m=1.0)
    arm = poses[:, :3, 3] - TARGET_M

    np.testing.assert_allclose(np.degrees(np.arcsin(arm[:, 2])), [20, 30, 40, 50, 60, 55, 50, 45, 40])


def test_look_at_errors_turn_the_camera_and_leave_its_place() -> None:
    """Their root mean square is the set deviation over two axes."""
    aimed = path(frames=2000, degrees_per_frame=0.1, start_deg=0.0, look_at_error_deg=2.0)
    exact = path(frames=2000, degrees_per_frame=0.1, start_deg=0.0)

    np.testing.assert_array_equal(aimed[:, :3, 3], exact[:, :3, 3])
    error = angles_deg(aimed[:, :3, 2], exact[:, :3, 2])
    assert abs(np.sqrt((error**2).mean()) - 2.0 * np.sqrt(2)) < 0.2


def test_rings_spread_views_over_whole_circles() -> None:
    """Odd counts are dealt out; azimuths of one ring are equally spaced."""
    poses = path(kind="rings", frames=7, elevations_deg=(25.0, 55.0), radius_m=0.8)
    arm = poses[:, :3, 3] - TARGET_M
    elevation = np.degrees(np.arcsin(arm[:, 2] / 0.8))

    np.testing.assert_allclose(elevation, [25.0] * 4 + [55.0] * 3)
    azimuth = np.degrees(np.arctan2(arm[:, 1], arm[:, 0]))
    np.testing.assert_allclose(np.diff(azimuth[:4]) % 360, 90.0)
    np.testing.assert_allclose(np.diff(azimuth[4:]) % 360, 120.0)


def test_a_hand_held_camera_moves_at_the_set_pace_and_shakes() -> None:
    """The mean step holds; without shake neighbouring frames are smooth."""
    shaky = path(kind="handheld", frames=300, degrees_per_frame=1.0)
    smooth = path(kind="handheld", frames=300, degrees_per_frame=1.0, shake_m=0.0, shake_deg=0.0)

    def jerk_m(poses: np.ndarray) -> float:
        return float(np.abs(np.diff(poses[:, :3, 3], n=2, axis=0)).mean())

    assert jerk_m(shaky) > 5 * jerk_m(smooth)
    arm = np.unwrap(np.arctan2(*(smooth[:, :2, 3] - TARGET_M[:2]).T[::-1]))
    assert 0.6 < np.degrees(arm[-1] - arm[0]) / 299 < 1.4


def test_the_seed_decides() -> None:
    """The same path for the same seed, another for another."""
    settings = {"kind": "handheld", "frames": 5}

    np.testing.assert_array_equal(path(1, **settings), path(1, **settings))
    assert not np.allclose(path(1, **settings), path(2, **settings))


@pytest.mark.parametrize("settings", [{"frames": 0}, {"radius_m": 0.0}, {"elevations_deg": (95.0,)}])
def test_settings_that_make_no_path_are_refused(settings: dict[str, object]) -> None:
    """On construction."""
    with pytest.raises(ValueError, match="must"):
        PathConfig(**settings)  # type: ignore[arg-type]
