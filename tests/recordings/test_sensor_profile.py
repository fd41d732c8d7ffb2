"""A sensor's distortion field: drawn, written, read, and taken off the depths."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from scipy.interpolate import CubicSpline

from recordings.distortion_field import (
    NODE_COLUMNS,
    NODE_ROWS,
    DistortionField,
    node_weights,
    pixel_weights,
)
from recordings.errors import RecordingError
from recordings.options import ReadOptions
from recordings.reading import open_recording
from recordings.sensor_profile import (
    UNKNOWN_KINDS,
    UNKNOWN_PARTS,
    ProfileSource,
    ResidualCorrelation,
    SensorProfile,
    UnknownTable,
    load_sensor_profile,
    read_sensor_profile,
)
from recordings.types import CameraIntrinsics, DepthNoise, Frame
from recordings.writer import RecordingWriter

CAMERA = CameraIntrinsics(width=64, height=48, fx=56.0, fy=56.0, cx=31.5, cy=23.5)


def _field(rng: np.random.Generator) -> DistortionField:
    values = rng.normal(scale=2e-3, size=(NODE_ROWS, NODE_COLUMNS))
    return DistortionField(disparity_per_m=values, sd_per_m=np.full(values.shape, 1e-3))


def _profile(rng: np.random.Generator) -> SensorProfile:
    """With every table."""
    weights = rng.dirichlet(np.ones(UNKNOWN_PARTS), (2, UNKNOWN_KINDS))
    scales = rng.uniform(0.5, 5.0, (2, UNKNOWN_PARTS - 1))
    return SensorProfile(
        intrinsics=CAMERA,
        noise=DepthNoise(sigma_base_m=0.0015, outlier_probability=0.02),
        correlation=ResidualCorrelation(x_px=4.5, y_px=2.0),
        distortion=_field(rng),
        unknown=UnknownTable(
            pitches_rad=np.array([0.005, 0.01]), weights=weights, scales=scales, reach_m=2.5
        ),
        source=ProfileSource(recordings=("a.mcap", "b.mcap"), frames=24, version="0.1.0"),
    )


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
    profile = _field(rng)
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


def test_limits_are_of_corrected_depths(seed, tmp_path):
    """What the field moves out of them is left out, what it moves in stays; nothing is moved far off."""
    bent = np.full((NODE_ROWS, NODE_COLUMNS), 0.05)
    field = DistortionField(disparity_per_m=bent, sd_per_m=np.full(bent.shape, 1e-3))
    depth = np.random.default_rng(seed).uniform(0.5, 19.9999, (48, 64)).astype(np.float32)
    depth[0, 0] = 19.9999
    with RecordingWriter(tmp_path / "a.mcap", CAMERA, depth_unit_m=None) as writer:
        writer.write_depth(Frame(time_ns=0, depth_m=depth))
    sensor = _written(replace(_profile(np.random.default_rng(seed)), distortion=field), tmp_path / "s.toml")

    (free,) = open_recording(tmp_path / "a.mcap", ReadOptions(sensor=sensor))
    options = ReadOptions(sensor=sensor, min_depth_m=1.0, max_depth_m=5.0)
    (limited,) = open_recording(tmp_path / "a.mcap", options)

    true = 1 / (1 / depth - 0.05)
    clear = np.minimum(np.abs(true - 1.0), np.abs(true - 5.0)) > 1e-4
    expected = np.where((true >= 1.0) & (true <= 5.0), true, 0.0)
    np.testing.assert_allclose(limited.depth_m[clear], expected[clear], rtol=1e-5)
    assert free.depth_m.max() <= 2 * depth.max()


def test_a_file_gives_back_the_profile(seed, tmp_path):
    """Every table to the last bit, and each may be missing."""
    profile = _profile(np.random.default_rng(seed))
    for one in (profile, replace(profile, distortion=None), replace(profile, unknown=None, noise=None)):
        found = load_sensor_profile(_written(one, tmp_path / "sensor.toml"))
        assert found.table() == one.table()


def test_a_file_of_version_1_is_read(seed, tmp_path):
    """It had the field alone."""
    table = _profile(np.random.default_rng(seed)).table()
    old = {"format_version": 1, "image": table["image"], "distortion": table["distortion"]}
    (tmp_path / "sensor.toml").write_text(tomli_w.dumps(old))
    found = load_sensor_profile(tmp_path / "sensor.toml")
    assert found.table()["distortion"] == table["distortion"]
    assert found.noise is None


@pytest.mark.parametrize(("version", "parts"), [(2, 6), (3, 8)])
def test_the_unknown_layer_of_earlier_versions_is_left_out(version, parts, seed, tmp_path):
    """It has other predictions, or kinds of edges; all the rest is as it was."""
    table = _profile(np.random.default_rng(seed)).table()
    weights, scales = np.full((2, 10, parts), 1 / parts), np.ones((2, parts - 1))
    table["unknown"] |= {"weights": weights.tolist(), "scales": scales.tolist()}
    (tmp_path / "sensor.toml").write_text(tomli_w.dumps(table | {"format_version": version}))
    found = load_sensor_profile(tmp_path / "sensor.toml")
    assert found.unknown is None
    assert found.table()["noise"] == table["noise"]


def test_the_unknown_layer_is_taken_at_the_nearest_step(seed):
    """Within a factor of 1.6; farther off it is refused in one line."""
    table = _profile(np.random.default_rng(seed)).unknown
    assert table is not None
    for pitch, number in ((0.0045, 0), (0.0068, 0), (0.0072, 1), (0.015, 1)):
        weights, scales = table.at(pitch)
        np.testing.assert_array_equal(weights, table.weights[number])
        np.testing.assert_array_equal(scales, table.scales[number])
    with pytest.raises(ValueError, match="calibrate on images of this size"):
        table.at(0.017)


TABLES = _profile(np.random.default_rng(0)).table()
TOO_LITTLE = np.full((2, UNKNOWN_KINDS, UNKNOWN_PARTS), 0.1).tolist()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format_version": 5}, "format_version"),
        ({"distortion": {"disparity_per_m": [[0.0]], "sd_per_m": [[1.0]]}}, "7 rows of 9"),
        ({"distortion": {"disparity_per_m": 7 * [9 * [float("nan")]]}}, "sd_per_m is not there"),
        ({"image": {**vars(CAMERA), "fx": 70.0}}, "another camera"),
        ({"image": {**vars(CAMERA), "fx": 10**400}}, "image.fx is larger than any number"),
        ({"image": {**vars(CAMERA), "width": 10**400}}, "image.width must be a whole number"),
        ({"distortion": {"disparity_per_m": [[10**400]], "sd_per_m": [[1.0]]}}, "rows of as many numbers"),
        ({"image": "none"}, "no sensor profile"),
        ({"noise": {"sigma_base_m": -0.001}}, "sigma_base_m must lie within"),
        ({"noise": {"sigma_base_m": "much"}}, "noise.sigma_base_m must be a number"),
        ({"noise": {"max_range_m": float("inf")}}, "max_range_m must be a finite number"),
        ({"noise": {"sigma": 0.001}}, "there is no noise.sigma"),
        ({"correlation": {"x_px": -1.0, "y_px": 1.0}}, "x_px must lie within"),
        ({"unknown": {**TABLES["unknown"], "scales": [[1.0]]}}, "unknown.scales must be 2 x 7"),
        ({"unknown": {**TABLES["unknown"], "scales": [[1.0], [1.0, 2.0]]}}, "rows of as many numbers"),
        ({"unknown": {**TABLES["unknown"], "weights": TOO_LITTLE}}, "sum to 1"),
        ({"unknown": {**TABLES["unknown"], "reach_m": 0}}, "reach_m must be positive"),
        ({"source": {"recordings": [1], "frames": 1, "version": "0"}}, "must be a word"),
    ],
)
def test_a_profile_that_cannot_be_used_is_refused_in_one_line(tmp_path, change, message):
    """The file is named."""
    (tmp_path / "sensor.toml").write_text(tomli_w.dumps(TABLES | change))

    with pytest.raises(RecordingError, match=message) as raised:
        read_sensor_profile(tmp_path / "sensor.toml", CAMERA)

    assert "sensor.toml" in str(raised.value)
    assert "\n" not in str(raised.value)


def test_damaged_files_are_refused_in_one_line(seed, tmp_path):
    """Cut anywhere, or with a byte changed: read as it was meant, or refused; never a traceback."""
    rng = np.random.default_rng(seed)
    whole = tomli_w.dumps(TABLES).encode()
    path, refused = tmp_path / "sensor.toml", 0
    for trial in range(60):
        content = bytearray(whole)
        if trial % 2:
            content[rng.integers(len(content))] = rng.integers(256)
        else:
            content = content[: rng.integers(len(content))]
        path.write_bytes(content)
        try:
            load_sensor_profile(path)
        except RecordingError as error:
            refused += 1
            assert "\n" not in str(error)  # noqa: PT017  (no exception is right, too)
    assert refused > 30


def test_no_file_is_refused(tmp_path):
    """In one line."""
    with pytest.raises(RecordingError, match="cannot read"):
        read_sensor_profile(tmp_path / "none.toml", CAMERA)
