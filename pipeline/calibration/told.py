"""What a calibration tells: for people, and for other programs."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.calibration.calibrate import Calibration, TrackedRecording
from shapes.calibration.noise_estimate import FEW_WINDOWS
from shapes.depth_noise import standard_deviation

TOLD_DEPTHS_M = np.array([0.5, 1.0, 2.0, 4.0])
FEW_FRAMES = 5


def document_of(calibration: Calibration) -> dict[str, Any]:
    """The object of --json: the file's tables but for the unknown layer, and how well founded they are."""
    content, estimate = calibration.profile.table(), calibration.estimate
    field, unknown = calibration.profile.distortion, calibration.profile.unknown
    assert calibration.profile.noise is not None
    sigma_m = standard_deviation(calibration.profile.noise, TOLD_DEPTHS_M)
    return {
        "image": content["image"],
        "noise": content["noise"],
        "sigma_m": {f"{depth:g}": float(one) for depth, one in zip(TOLD_DEPTHS_M, sigma_m, strict=True)},
        "correlation": content["correlation"],
        "smooth_windows": round(estimate.windows, 1),
        "windows_depth_m": list(estimate.depths_m),
        "distortion_per_m": None if field is None else float(np.abs(field.disparity_per_m).mean()),
        "distortion_std_per_m": None if field is None else float(field.sd_per_m.mean()),
        "tracked": [vars(one) for one in calibration.tracked],
        "unknown_pitches_rad": [] if unknown is None else unknown.pitches_rad.tolist(),
        "source": content["source"],
        "warnings": warnings_of(calibration),
    }


def warnings_of(calibration: Calibration) -> list[str]:
    """What speaks against the profile."""
    estimate, source = calibration.estimate, calibration.profile.source
    found = []
    if source is not None and source.frames < FEW_FRAMES:
        count = f"{source.frames} frame{'s' * (source.frames > 1)}"
        found.append(f"learnt from {count}: what is not seen there is not in it")
    if estimate.windows < FEW_WINDOWS:
        found.append(
            f"only {estimate.windows:.0f} small windows show one smooth surface: sigma and correlation are "
            "largely those of the usual sensor; film a wall, a floor or an empty table"
        )
    return found + [
        f"{one.name}: {one.lost} of {one.frames} frames were lost; it tells nothing of the distortion"
        for one in calibration.tracked
        if 2 * one.lost > max(one.frames, 1)
    ]


def lines_of(calibration: Calibration, path: str) -> list[str]:
    """A table for people."""
    document = document_of(calibration)
    image, noise, correlation = document["image"], document["noise"], document["correlation"]
    sigmas = ", ".join(f"{1e3 * sigma:.2g} at {depth} m" for depth, sigma in document["sigma_m"].items())
    near, far = document["windows_depth_m"]
    pitches = ", ".join(f"{1e3 * one:.2g}" for one in document["unknown_pitches_rad"])
    rows = [
        ("camera", f"{image['width']}x{image['height']}, fx {image['fx']:.1f}, fy {image['fy']:.1f}"),
        ("frames", f"{document['source']['frames']} of {', '.join(document['source']['recordings'])}"),
        ("sigma, mm", sigmas),
        ("", f"by {document['smooth_windows']:.0f} smooth windows, {near:.2g} to {far:.2g} m"),
        ("missing", f"{noise['none_hit_probability']:.1%} of what should return"),
        ("outliers", f"{noise['outlier_probability']:.1%} of the returns"),
        ("correlation", f"{correlation['x_px']:.1f} px along rows, {correlation['y_px']:.1f} along columns"),
        ("distortion", _field_text(calibration)),
        ("unknown layer", f"pixels {pitches} mrad apart"),
        ("written to", path),
    ]
    return [f"{name:<14}{text}" for name, text in rows]


def _field_text(calibration: Calibration) -> str:
    field = calibration.profile.distortion
    told = "; ".join(_tracked_text(one) for one in calibration.tracked)
    if field is None:
        return f"not learnt ({told})"
    return (
        f"{np.abs(field.disparity_per_m).mean():.1g}/m over the image, "
        f"known to {field.sd_per_m.mean():.1g}/m ({told})"
    )


def _tracked_text(one: TrackedRecording) -> str:
    if not one.frames:
        return f"{one.name} not tracked"
    return f"{one.name}: {one.frames} frames tracked, {one.lost} lost"
