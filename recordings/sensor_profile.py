"""What is known of one depth sensor, in one file (SENSOR.toml) for slam, learn and parse alike.

    format_version = 4
    [image]        width, height, fx, fy, cx, cy of the images that it was learnt from
    [noise]        parameters of the sensor density (`recordings.types.DepthNoise`)
    [correlation]  x_px, y_px: lengths over which residuals of neighbouring pixels are alike
    [distortion]   disparity_per_m, sd_per_m at the nodes of `recordings.distortion_field`
    [unknown]      how well pixels foretell each other (`UnknownTable`)
    [source]       recordings, frames, version

A table that was not learnt is not there. Version 1 had [image] and [distortion] alone; [unknown] of versions
2 and 3 had fewer predictions or kinds of edges: it is left out, and learnt anew from what is looked at.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from recordings.distortion_field import DistortionField
from recordings.errors import RecordingError
from recordings.settings import TEXT, check_finite, check_within
from recordings.types import CameraIntrinsics, DepthNoise

FORMAT_VERSION = 4
"""Of the file."""

LONGEST_PX = 1e3
"""Of a correlation: images are hardly larger."""

UNKNOWN_KINDS, UNKNOWN_PARTS = 12, 8
"""Rows and columns of the unknown layer's weights (`scene.likelihood.unknown_surfaces`)."""

PITCH_RATIO = 1.6
"""By which the angle between compared pixels may differ from one where the unknown layer was learnt: strides
are whole numbers of pixels, so that two sizes of a camera's images may be looked at up to 1.5 times as
coarsely one as the other."""

SAME_VIEW = 0.02
"""Share of the image by which two cameras' focal lengths and centres may differ: a tenth of a node's step."""

_LARGEST_WHOLE = 1 << 63
"""TOML's integers have 64 bits; Python's reader takes any."""

Part = TypeVar("Part")


@dataclass(frozen=True, kw_only=True)
class ResidualCorrelation:
    """Lengths over which errors of neighbouring pixels are alike: correlations are exp(-distance / length).

    Attributes:
        x_px: along the rows of the image, pixels; 0 where errors are independent.
        y_px: along its columns.
    """

    x_px: float
    y_px: float

    def __post_init__(self) -> None:
        check_finite(self)
        check_within(self, 0.0, LONGEST_PX, ("x_px", "y_px"))

    def resized(self, scale_x: float, scale_y: float) -> ResidualCorrelation:
        """Of the same view in an image larger by these factors."""
        return ResidualCorrelation(x_px=self.x_px * scale_x, y_px=self.y_px * scale_y)


@dataclass(frozen=True, kw_only=True, eq=False)
class UnknownTable:
    """How well a surface of which nothing is known is foretold by the pixels before, at several steps.

    Scales are in standard deviations of the profile's noise.

    Attributes:
        pitches_rad: (P,) angles from one compared pixel to the next.
        weights: (P, `UNKNOWN_KINDS`, `UNKNOWN_PARTS`) that sum to 1 over the last axis.
        scales: (P, `UNKNOWN_PARTS` - 1).
        reach_m: how far off a surface may begin.

    Raises:
        ValueError: an array has another shape, or a value that is not possible.
    """

    pitches_rad: NDArray[np.float64]
    weights: NDArray[np.float64]
    scales: NDArray[np.float64]
    reach_m: float

    def __post_init__(self) -> None:
        count = len(self.pitches_rad) if self.pitches_rad.ndim == 1 else 0
        if not count:
            raise ValueError("unknown.pitches_rad must be a list of angles")
        for name, shape in (
            ("weights", (count, UNKNOWN_KINDS, UNKNOWN_PARTS)),
            ("scales", (count, UNKNOWN_PARTS - 1)),
        ):
            if getattr(self, name).shape != shape:
                raise ValueError(f"unknown.{name} must be {' x '.join(map(str, shape))} numbers")
        for name in ("pitches_rad", "weights", "scales"):
            values = getattr(self, name)
            if not (np.isfinite(values) & (values > 0)).all():
                raise ValueError(f"unknown.{name} must be positive numbers")
        if not np.allclose(self.weights.sum(axis=-1), 1.0, atol=1e-3):
            raise ValueError("unknown.weights must sum to 1 in every row")
        if not 0 < self.reach_m < 1e3:
            raise ValueError(f"unknown.reach_m must be positive, got {self.reach_m}")

    def at(self, pitch_rad: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Weights (KINDS, PARTS) and scales (PARTS - 1,) of pixels so far apart: those learnt nearest to it.

        Raises:
            ValueError: none is near.
        """
        away = np.abs(np.log(self.pitches_rad / pitch_rad))
        nearest = int(np.argmin(away))
        if away[nearest] > np.log(PITCH_RATIO):
            known = ", ".join(f"{1e3 * one:.2g}" for one in self.pitches_rad)
            raise ValueError(
                f"the sensor profile knows pixels {known} mrad apart, scenes are compared on some "
                f"{1e3 * pitch_rad:.2g} mrad apart: calibrate on images of this size"
            )
        return self.weights[nearest], self.scales[nearest]


@dataclass(frozen=True, kw_only=True)
class ProfileSource:
    """Where a profile comes from.

    Attributes:
        recordings: names of their files.
        frames: depth frames that were looked at.
        version: of the program.
    """

    recordings: tuple[str, ...]
    frames: int
    version: str


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorProfile:
    """One sensor, as far as it is known.

    Attributes:
        intrinsics: of the images that it was learnt from.
        noise: of the sensor density.
        correlation: of residuals.
        distortion: the field by which inverse depths err.
        unknown: how well pixels foretell each other; its scales are those of `noise`.
        source: where all of it comes from.

    Raises:
        ValueError: the unknown layer is there without the noise.
    """

    intrinsics: CameraIntrinsics
    noise: DepthNoise | None = None
    correlation: ResidualCorrelation | None = None
    distortion: DistortionField | None = None
    unknown: UnknownTable | None = None
    source: ProfileSource | None = None

    def __post_init__(self) -> None:
        if self.unknown is not None and self.noise is None:
            raise ValueError("[unknown] counts in standard deviations of [noise], which is not there")

    def corrected(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """A depth image (H, W) without the distortion, as far as it is known."""
        return depth_m if self.distortion is None else self.distortion.corrected(depth_m)

    def table(self) -> dict[str, Any]:
        """What its TOML file says."""
        content: dict[str, Any] = {"format_version": FORMAT_VERSION, "image": vars(self.intrinsics)}
        for name in ("noise", "correlation", "distortion", "unknown", "source"):
            part = getattr(self, name)
            if part is not None:
                content[name] = {key: _plain(value) for key, value in vars(part).items()}
        return content


def load_sensor_profile(path: Path) -> SensorProfile:
    """The profile in a file.

    Raises:
        RecordingError: the file cannot be read, or says something impossible.
    """
    try:
        table = tomllib.loads(path.read_text(encoding=TEXT))
        version = table.pop("format_version", None)
        if version not in range(1, FORMAT_VERSION + 1):
            raise ValueError(f"format_version is {version}, not 1 to {FORMAT_VERSION}")
        if version < FORMAT_VERSION:
            table.pop("unknown", None)
        image = _part(CameraIntrinsics, table, "image")
        if image is None:
            raise ValueError("it has no [image]")
        return SensorProfile(
            intrinsics=image,
            noise=_part(DepthNoise, table, "noise"),
            correlation=_part(ResidualCorrelation, table, "correlation"),
            distortion=_part(DistortionField, table, "distortion"),
            unknown=_part(UnknownTable, table, "unknown"),
            source=_part(ProfileSource, table, "source"),
        )
    except OSError as error:
        raise RecordingError(f"cannot read the sensor profile {path}: {error.strerror}") from error
    except (ValueError, TypeError, RecursionError) as error:
        raise RecordingError(f"{path} is no sensor profile: {error}") from error


def read_sensor_profile(path: Path, intrinsics: CameraIntrinsics) -> SensorProfile:
    """The profile in a file, of the sensor that takes images with these intrinsics.

    Raises:
        RecordingError: the file cannot be read, says something impossible, or is of another camera.
    """
    profile = load_sensor_profile(path)
    if not same_view(profile.intrinsics, intrinsics):
        raise RecordingError(
            f"{path} is the profile of another camera: {_named(profile.intrinsics)}, "
            f"the recording's is {_named(intrinsics)}"
        )
    return profile


def same_view(one: CameraIntrinsics, other: CameraIntrinsics) -> bool:
    """Whether two cameras see the same field of view, whatever the number of pixels."""
    alike = one.resized(other.width, other.height)
    sides = np.asarray([other.width, other.height, other.width, other.height])
    differences = [getattr(alike, name) - getattr(other, name) for name in ("fx", "fy", "cx", "cy")]
    return bool((np.abs(differences) <= SAME_VIEW * sides).all())


def _part(kind: type[Part], table: Mapping[str, Any], name: str) -> Part | None:
    """The table of that name as a value; None where it is not there."""
    if name not in table:
        return None
    given = table[name]
    if not isinstance(given, Mapping):
        raise ValueError(f"{name} must be a table, [{name}]")
    known = {field.name: field for field in fields(kind)}  # type: ignore[arg-type]
    if unknown := sorted(set(given) - set(known)):
        raise ValueError(f"there is no {name}.{unknown[0]}; there are {', '.join(known)}")
    if missing := [key for key, field in known.items() if key not in given and field.default is MISSING]:
        raise ValueError(f"{name}.{missing[0]} is not there")
    return kind(
        **{key: _READERS[str(known[key].type)](f"{name}.{key}", value) for key, value in given.items()}
    )


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name} must be a number, got {value!r}")
    try:
        return float(value)
    except OverflowError as error:
        raise ValueError(f"{name} is larger than any number can be") from error


def _whole(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or abs(value) >= _LARGEST_WHOLE:
        raise ValueError(f"{name} must be a whole number, got {value!r}")
    return value


def _word(name: str, value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{name} must be a word, got {value!r}")
    return value


def _words(name: str, value: Any) -> tuple[str, ...]:
    if not isinstance(value, list):
        raise ValueError(f"{name} must be a list of words, got {value!r}")
    return tuple(_word(name, one) for one in value)


def _numbers(name: str, value: Any) -> NDArray[np.float64]:
    try:
        return np.asarray(value if isinstance(value, list) else None, np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"{name} must be rows of as many numbers each") from error


_READERS: Mapping[str, Callable[[str, Any], Any]] = {
    "float": _number,
    "int": _whole,
    "str": _word,
    "tuple[str, ...]": _words,
    "NDArray[np.float64]": _numbers,
}
"""How a field of a part is read, by its type."""


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _named(camera: CameraIntrinsics) -> str:
    return f"{camera.width}x{camera.height} with fx {camera.fx:g}, cx {camera.cx:g}, cy {camera.cy:g}"
