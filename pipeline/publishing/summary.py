"""summary.json and timing.json: the fields that other programs rely on (metres, radians, seconds)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from pipeline.publishing.finite import are_poses, finite_json, remarks_on
from pipeline.publishing.hidden_regions import regions_of
from pipeline.publishing.told_spread import undiscovered_text
from pipeline.publishing.trajectory_files import seconds_text
from pipeline.publishing.values import RunValues
from pipeline.run_folder import RunFolder
from pipeline.surfaces import Surfaces
from scene.copies import copies_among
from scene.diagnostics import ENOUGH_SAMPLES, Convergence, scene_convergence
from scene.result import FACES, SceneResult
from shapes.geometry.poses import matrices_of
from shapes.prior import ShapePrior
from slam.result import SlamResult

MOST_ENCLOSED, MOST_BODIES, LARGEST_M = 5.0, 20, 0.4
"""Beyond these a learned shape is told to be doubtful. A hand-held scan of which a whole shelf was taken for
the object had 37 times as many enclosed voxels as seen ones, in 1160 bodies."""
LEAST_REGION = 0.001
"""Probability of a region that is told: a few hundred poses of the posterior tell no smaller ones."""
MOST_SWEEPS_FACTOR = 20.0
"""Chains longer than this many times the default have not been measured (README, "Measured")."""


def summary_of(values: RunValues) -> dict[str, Any]:
    """What was found, by stage; equal values give equal summaries."""

    def told(stage: str, content: dict[str, Any]) -> dict[str, Any]:
        """A stage's object with what is to be said of it; JSON holds no number that is not finite."""
        own = content.pop("warnings", ())
        warnings = [*values.warnings.get(stage, ()), *own, *remarks_on(content)]
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
    found = np.flatnonzero(~result.lost)
    places, spread = result.mean[found, :3, 3], result.covariance[found, :3, :3]
    deviations_m = np.sqrt(np.maximum(np.trace(spread, axis1=1, axis2=2), 0.0))
    return {
        "frames": len(result),
        "lost_frames": int(result.lost.sum()),
        "lost": [
            {"frame": frame, "stamp": seconds_text(int(result.times_ns[frame]))}
            for frame in np.flatnonzero(result.lost).tolist()
        ],
        "length_m": float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()),
        "position_std_m": float(np.median(deviations_m)) if len(found) else None,
        "largest_position_std_m": float(deviations_m.max()) if len(found) else None,
        "least_sure_frame": int(found[np.argmax(deviations_m)]) if len(found) else None,
        "distortion_per_m": float(np.abs(result.disparity_per_m).mean()),
        "distortion_std_per_m": float(result.disparity_sd_per_m.mean()),
        "hypotheses_max": float(result.hypotheses.max()),
        "path_probabilities": np.round(result.path_probabilities, 6).tolist(),
        "undiscovered_probability": float(result.undiscovered),
        "log_evidence": float(result.log_evidence.sum()),
        "warnings": [text] if (text := undiscovered_text(float(result.undiscovered))) else [],
    }


def _shape(shape: ShapePrior) -> dict[str, Any]:
    return {
        "pitch_m": shape.pitch_m,
        "voxels": list(shape.phi.shape),
        "seen_occupied": int(shape.seen_occupied.sum()),
        "seen_free": int(shape.seen_free.sum()),
        "enclosed": int(shape.enclosed.sum()),
        "size_m": np.round(np.ptp(shape.bounding_box_m, axis=0), 9).tolist() if shape.solid.any() else None,
        **_surface(shape),
    }


def _surface(shape: ShapePrior) -> dict[str, Any]:
    """How much of the surface was seen, of how many bodies it is, and what speaks against it."""
    if not (shape.solid.any() and shape.has_surface):
        return {"surface": None, "bodies": 0, "warnings": ["no voxel is solid"]}
    shares = shape.surface_shares(shape.surface())
    _, bodies = label(shape.solid)  # type: ignore[misc]
    seen, enclosed = int(shape.seen_occupied.sum()), int(shape.enclosed.sum())
    longest_m = float(np.ptp(shape.bounding_box_m, axis=0).max())
    warnings = []
    if enclosed > MOST_ENCLOSED * seen:
        warnings.append(
            f"{enclosed / max(seen, 1):.0f} times as many voxels enclosed as seen: most of it is a guess"
        )
    if bodies > MOST_BODIES:
        warnings.append(f"it is of {bodies} separate bodies: more than one thing, or noise")
    if longest_m > LARGEST_M:
        warnings.append(f"it is {100 * longest_m:.0f} cm long: is it one object? give its place with --box")
    return {
        "surface": {state.name.lower(): share for state, share in shares.items()},
        "bodies": int(bodies),
        "warnings": warnings,
    }


def _scene(scene: SceneResult, surfaces: Surfaces) -> dict[str, Any]:
    """Objects that were found, and the edges between them, in the camera of the first frame used."""
    found = np.flatnonzero(scene.found).tolist()
    names = [*scene.names.tolist(), *scene.supports]
    middles_m = np.stack([surfaces.by_name[name].middle_m for name in scene.names.tolist()])
    agreement = scene_convergence(scene, middles_m)
    return {
        "frames": scene.frames.tolist(),
        "samples": len(scene.sample_poses),
        **_convergence(agreement.overall),
        "sweeps_advised": sweeps_advised(scene, agreement.overall),
        "acceptance": float(scene.acceptance),
        "log_estimate_variance": float(scene.log_estimate_variance),
        "objects": [
            {
                "name": names[one],
                "presence": float(scene.presence[one]),
                "presence_std": float(scene.presence_std[one]),
                "camera_from_object": scene.camera_from_object[one].tolist(),
                "position_std_m": float(scene.position_std_m[one]),
                "rotation_std_rad": float(scene.rotation_std_rad[one]),
                **_middle(scene, one, middles_m[one]),
                **_convergence(agreement.centres[one]),
                "modes_converged": agreement.modes[one].converged,
                "visible_fraction": float(scene.visible_fraction[one]),
                "colour_nats": float(scene.colour_nats[one]),
                "modes": _modes(scene, one, middles_m[one]),
            }
            for one in found
        ],
        "not_found": [
            {
                "name": names[one],
                "presence": float(scene.presence[one]),
                "presence_std": float(scene.presence_std[one]),
                "in_sight": float(scene.presence[one] - scene.presence_out_of_sight[one]),
                "hidden_share": float(scene.hidden_share[one]),
                "regions": _regions(scene, one, middles_m[one]),
            }
            for one in np.flatnonzero(~scene.found).tolist()
        ],
        "counts": _counts(scene, surfaces),
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


def _counts(scene: SceneResult, surfaces: Surfaces) -> list[dict[str, Any]]:
    """Of shapes of which several were asked for: probabilities that none, one, two and so on are there."""
    names = scene.names.tolist()
    told = []
    alike = copies_among({name: surfaces.by_name[name].vertices_m for name in names})
    for first, copies in enumerate(alike):
        if copies.sum() > 1 and copies.argmax() == first:
            shares = scene.number_probabilities[first, : copies.sum() + 1]
            told.append({"name": names[first], "probabilities": shares.tolist()})
    return told


def _regions(scene: SceneResult, one: int, middle_m: NDArray[np.float64]) -> list[dict[str, Any]]:
    """Where an object that was not found may be, likeliest region first; corners of where its middle is."""
    if not scene.hidden_share[one] > 0:
        return []
    poses = matrices_of(scene.hidden_poses[one][are_poses(scene.hidden_poses[one])])
    regions = regions_of(
        float(scene.presence_out_of_sight[one]), poses[:, :3, :3] @ middle_m + poses[:, :3, 3]
    )
    return [
        {"probability": each.probability, "low_m": each.low_m.tolist(), "high_m": each.high_m.tolist()}
        for each in regions
        if each.probability >= LEAST_REGION
    ]


def sweeps_advised(scene: SceneResult, agreement: Convergence) -> int | None:
    """Sweeps with which chains would gather enough effective samples, were they to go on as they do.

    None where they agree already, or are too short to tell. A third of the sweeps is dropped.
    """
    if agreement.converged or not np.isfinite(agreement.effective_samples):
        return None
    chains = int(scene.chain.max(initial=0)) + 1
    factor = min(ENOUGH_SAMPLES / max(agreement.effective_samples, 1.0), MOST_SWEEPS_FACTOR)
    return int(np.ceil(1.5 * len(scene.chain) / chains * max(factor, 2.0) / 60) * 60)


def _convergence(agreement: Convergence) -> dict[str, Any]:
    """As JSON has it: null for what is not finite."""

    def finite(value: float) -> float | None:
        return value if np.isfinite(value) else None

    return {
        "converged": agreement.converged,
        "r_hat": finite(agreement.r_hat),
        "effective_samples": finite(agreement.effective_samples),
        "effective_samples_bulk": finite(agreement.bulk_samples),
        "effective_samples_tail": finite(agreement.tail_samples),
    }


def _middle(scene: SceneResult, one: int, middle_m: NDArray[np.float64]) -> dict[str, Any]:
    """Where the middle of an object is, in the camera, and the root mean square distance from there."""
    pose = scene.camera_from_object[one]
    return {
        "middle_m": (pose[:3, :3] @ middle_m + pose[:3, 3]).tolist(),
        "middle_std_m": float(np.sqrt(np.trace(scene.covariance_of_point(one, middle_m)))),
    }


def _modes(scene: SceneResult, one: int, middle_m: NDArray[np.float64]) -> list[dict[str, Any]]:
    """The modes of an object's pose, the heaviest first, with the spread of its middle in each."""
    return [
        {
            "camera_from_object": scene.mode_poses[one, mode].tolist(),
            "probability": float(scene.mode_probabilities[one, mode]),
            "middle_std_m": float(np.sqrt(np.trace(scene.covariance_of_point(one, middle_m, mode)))),
        }
        for mode in np.flatnonzero(
            np.isfinite(scene.mode_probabilities[one]) & (scene.mode_probabilities[one] > 0)
        ).tolist()
    ]
