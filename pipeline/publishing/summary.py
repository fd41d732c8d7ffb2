"""summary.json and timing.json: the fields that other programs rely on (metres, radians, seconds)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.publishing.finite import finite_json, remarks_on
from pipeline.publishing.trajectory_files import seconds_text
from pipeline.publishing.values import RunValues
from pipeline.run_folder import RunFolder
from pipeline.surfaces import Surfaces
from scene.diagnostics import convergence
from scene.result import FACES, SceneResult
from shapes.prior import ShapePrior
from slam.result import SlamResult


def summary_of(values: RunValues) -> dict[str, Any]:
    """What was found, by stage; equal values give equal summaries."""

    def told(stage: str, content: dict[str, Any]) -> dict[str, Any]:
        """A stage's object with what is to be said of it; JSON holds no number that is not finite."""
        warnings = [*values.warnings.get(stage, ()), *remarks_on(content)]
        return {**finite_json(content), "warnings": warnings}

    summary: dict[str, Any] = {}
    if values.slam is not None:
        summary["slam"] = told("slam", _slam(values.slam))
    if values.shapes:
        summary["learn"] = {
            name: told(f"learn/{name}", _shape(shape)) for name, shape in values.shapes.items()
        }
    if values.scene is not None and values.surfaces is not None:
        summary["parse"] = told("parse", _scene(values.scene, values.surfaces))
    return summary


def timing_of(run: RunFolder, values: RunValues) -> dict[str, Any]:
    """How long each stage took when it was computed; clocks stand nowhere else."""
    timing: dict[str, Any] = {}
    for stage, record in run.records().items():
        figures: dict[str, Any] = {"seconds": record.seconds, "compile_s": record.compile_s}
        figures["machine"] = record.machine
        kind, _, name = stage.partition("/")
        if stage == "slam" and values.slam is not None:
            figures["frames_per_second"] = round(len(values.slam) / max(record.seconds, 1e-6), 3)
        if name:
            timing.setdefault(kind, {})[name] = figures
        else:
            timing[kind] = figures
    return timing


def _slam(result: SlamResult) -> dict[str, Any]:
    return {
        "frames": len(result),
        "lost_frames": int(result.lost.sum()),
        "lost": [
            {"frame": frame, "stamp": seconds_text(int(result.times_ns[frame]))}
            for frame in np.flatnonzero(result.lost).tolist()
        ],
        "ess_min": float(result.ess.min()),
        "path_probabilities": np.round(result.path_probabilities, 6).tolist(),
        "log_evidence": float(result.log_evidence.sum()),
    }


def _shape(shape: ShapePrior) -> dict[str, Any]:
    return {
        "pitch_m": shape.pitch_m,
        "voxels": list(shape.phi.shape),
        "seen_occupied": int(shape.seen_occupied.sum()),
        "seen_free": int(shape.seen_free.sum()),
        "enclosed": int(shape.enclosed.sum()),
        "size_m": np.round(np.ptp(shape.bounding_box_m, axis=0), 9).tolist() if shape.solid.any() else None,
    }


def _scene(scene: SceneResult, surfaces: Surfaces) -> dict[str, Any]:
    """Objects that were found, and the edges between them, in the camera of the first frame used."""
    found = np.flatnonzero(scene.found).tolist()
    names = [*scene.names.tolist(), *scene.supports]
    middles_m = np.stack([surfaces.by_name[name].middle_m for name in scene.names.tolist()])
    with np.errstate(invalid="ignore"):  # a sample of no density leaves nothing to compare
        agreement = convergence(scene, middles_m)
    return {
        "frames": scene.frames.tolist(),
        "samples": len(scene.sample_poses),
        "r_hat": agreement.r_hat if np.isfinite(agreement.r_hat) else None,
        "effective_samples": agreement.effective_samples
        if np.isfinite(agreement.effective_samples)
        else None,
        "acceptance": float(scene.acceptance),
        "log_estimate_variance": float(scene.log_estimate_variance),
        "objects": [
            {
                "name": names[one],
                "presence": float(scene.presence[one]),
                "camera_from_object": scene.camera_from_object[one].tolist(),
                "position_std_m": float(scene.position_std_m[one]),
                "rotation_std_rad": float(scene.rotation_std_rad[one]),
                **_middle(scene, one, surfaces.by_name[names[one]].middle_m),
                "visible_fraction": float(scene.visible_fraction[one]),
                "modes": [
                    {"camera_from_object": pose.tolist(), "probability": float(share)}
                    for pose, share in zip(scene.mode_poses[one], scene.mode_probabilities[one], strict=True)
                    if share > 0
                ],
            }
            for one in found
        ],
        "not_found": [
            {"name": names[one], "presence": float(scene.presence[one])}
            for one in np.flatnonzero(~scene.found).tolist()
        ],
        "graph": [
            {
                "child": names[child],
                "parent": names[parent],
                "probability": float(scene.edge_probabilities[child, parent]),
                "child_face": FACES[scene.edge_faces[child, parent, 0]],
                "parent_face": FACES[scene.edge_faces[child, parent, 1]],
            }
            for child in found
            for parent in np.flatnonzero(scene.edge_probabilities[child] > 0)
        ],
    }


def _middle(scene: SceneResult, one: int, middle_m: NDArray[np.float64]) -> dict[str, Any]:
    """Where the middle of an object is, in the camera, and the root mean square distance from there."""
    pose = scene.camera_from_object[one]
    return {
        "middle_m": (pose[:3, :3] @ middle_m + pose[:3, 3]).tolist(),
        "middle_std_m": float(np.sqrt(np.trace(scene.covariance_of_point(one, middle_m)))),
    }
