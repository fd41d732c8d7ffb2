"""A sensor's distortion field: drawn, written, read, and taken off the depths."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from scipy.interpolate import CubicSpline

from recordings.errors import RecordingError
from recordings.options import ReadOptions
from recordings.reading import open_recording
from recordings.sensor_profile import (
    NODE_COLUMNS,
    NODE_ROWS,
    SensorProfile,
    node_weights,
    pixel_weights,
    read_sensor_profile,
)
from recordings.types import CameraIntrinsics, Frame
from recordings.writer import RecordingWriter

CAMERA = CameraIntrinsics(width=64, height=48, fx=56.0, fy=56.0, cx=31.5, cy=23.5)


def _profile(rng: np.random.Generator) -> SensorProfile:
    field = rng.normal(scale=2e-3, size=(NODE_ROWS, NODE_COLUMNS))
    return SensorProfile(intrinsics=CAMERA, disparity_per_m=field, sd_per_m=np.full(field.shape, 1e-3))


def _written(profile: SensorProfile, path: Path) -> Path:
    path.write_text(tomli_w.dumps(profile.table()))
    return path


def test_between_nodes_the_field_is_the_natural_spline(seed):
    """Against SciPy's, to rounding."""
    values, at = np.random.default_rng(seed).normal(size=NODE_COLUMNS), np.linspace(0, 1, 57)
    expected = CubicSpline(np.linspace(0, 1, NODE_COLUMNS), values, bc_type="natural")(at)
    np.testing.assert_allclose(node_weights(at, NODE_COLUMNS) @ values, expected, atol=1e-12)


def test_correction_undoes_the_distortion(seed):
    """1 / z = 1 / z_measured - d; what did not return stays so, and what would lie behind infinity too."""
    rng = np.random.default_rng(seed)
    profile = _profile(rng)
    rows, columns = pixel_weights(64, 48)
    true = rng.uniform(0.5, 5.0, (48, 64))
    measured = (1.0 / (1.0 / true + rows @ profile.disparity_per_m @ columns.T)).astype(np.float32)
    measured[3, 4], measured[5, 6] = 0.0, 1e6

    found = profile.corrected(measured)

    assert found[3, 4] == 0.0
    assert found[5, 6] == 0.0 or rows[5] @ profile.disparity_per_m @ columns[6] < 0
    true[3, 4] = true[5, 6] = found[3, 4] = found[5, 6] = 1.0
    np.testing.assert_allclose(found, true, rtol=1e-5)


def test_a_recording_is_read_with_the_profile_of_its_camera(seed, tmp_path):
    """The same camera at another size will do; no profile gives the stored depths."""
    profile = _profile(np.random.default_rng(seed))
    depth = np.full((48, 64), 1.5, np.float32)
    with RecordingWriter(tmp_path / "a.mcap", CAMERA, depth_unit_m=None) as writer:
        writer.write_depth(Frame(time_ns=0, depth_m=depth))
    twice = replace(profile, intrinsics=CAMERA.resized(128, 96))
    options = ReadOptions(sensor=_written(twice, tmp_path / "sensor.toml"))

    (plain,), (corrected,) = open_recording(tmp_path / "a.mcap"), open_recording(tmp_path / "a.mcap", options)

    np.testing.assert_array_equal(plain.depth_m, depth)
    np.testing.assert_array_equal(corrected.depth_m, profile.corrected(depth))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format_version": 2}, "format_version"),
        ({"distortion": {"disparity_per_m": [[0.0]], "sd_per_m": [[1.0]]}}, "7 rows of 9"),
        ({"distortion": {"disparity_per_m": 7 * [9 * [float("nan")]]}}, "no sensor profile"),
        ({"image": {**vars(CAMERA), "fx": 70.0}}, "another camera"),
        ({"image": "none"}, "no sensor profile"),
    ],
)
def test_a_profile_that_cannot_be_used_is_refused_in_one_line(seed, tmp_path, change, message):
    """The file is named."""
    table = _profile(np.random.default_rng(seed)).table() | change
    (tmp_path / "sensor.toml").write_text(tomli_w.dumps(table))

    with pytest.raises(RecordingError, match=message) as raised:
        read_sensor_profile(tmp_path / "sensor.toml", CAMERA)

    assert "sensor.toml" in str(raised.value)
    assert "\n" not in str(raised.value)


def test_no_file_is_refused(tmp_path):
    """In one line."""
    with pytest.raises(RecordingError, match="cannot read"):
        read_sensor_profile(tmp_path / "none.toml", CAMERA)
