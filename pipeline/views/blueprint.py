"""How the views of a run are arranged, and where the eye stands."""

from __future__ import annotations

import numpy as np
import rerun.blueprint as rrb
from numpy.typing import NDArray

from pipeline.publishing.values import RunValues
from pipeline.views.scene_view import found_places_m


def run_blueprint(values: RunValues) -> rrb.Blueprint:
    """The room large on the left; what the camera saw, shapes, plots and the report on the right."""
    side: list[rrb.ContainerLike] = []
    if values.room is not None:
        images = [rrb.Spatial2DView(origin="world/camera", contents="world/camera/depth", name="Depth")]
        if values.room.view_rgb is not None:
            images.append(
                rrb.Spatial2DView(origin="world/camera", contents="world/camera/colour", name="Colour")
            )
        side.append(rrb.Horizontal(*images))
    if values.shapes:
        side.append(rrb.Tabs(*(_shape_view(name, values) for name in values.shapes)))
    if values.scene is not None:
        side.append(rrb.GraphView(origin="graph", name="What rests on what"))
    report = rrb.TextDocumentView(origin="report", name="Report")
    side.append(rrb.Horizontal(_plots(), report) if values.slam is not None else report)
    return rrb.Blueprint(
        rrb.Horizontal(_room_view(values), rrb.Vertical(*side), column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline="frame"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _plots() -> rrb.Tabs:
    """How sure the filter was, over the frames."""
    plots = [
        rrb.TimeSeriesView(origin=f"plots/{path}", name=name)
        for path, name in (
            ("position", "Position, standard deviation"),
            ("rotation", "Rotation, standard deviation"),
            ("ess", "Effective sample size"),
            ("evidence", "Log evidence"),
        )
    ]
    return rrb.Tabs(*plots)


def _room_view(values: RunValues) -> rrb.Spatial3DView:
    contents = ["world/**", "- world/camera/depth", "- world/camera/colour"]
    eye = None
    if values.scene is not None:
        eye = _eye_at_objects(values, upward(values))
    elif values.slam is not None:
        eye = _eye(values.slam.mean, upward(values))
    return rrb.Spatial3DView(
        origin="world",
        contents=contents,
        name="Room",
        eye_controls=eye,
        line_grid=False,
        background=[18, 20, 26, 255],
    )


def _shape_view(name: str, values: RunValues) -> rrb.Spatial3DView:
    shape = values.shapes[name]
    whole = np.array([np.zeros(3), shape.phi.shape]) * shape.pitch_m
    corners = shape.bounding_box_m if shape.solid.any() else whole
    centre, size = corners.mean(axis=0), float(np.linalg.norm(np.ptp(corners, axis=0)))
    eye = rrb.EyeControls3D(
        position=centre + size * np.array([0.75, -0.65, 0.55]), look_target=centre, eye_up=[0.0, 0.0, 1.0]
    )
    return rrb.Spatial3DView(
        origin=f"shapes/{name}", name=name, eye_controls=eye, line_grid=False, background=[18, 20, 26, 255]
    )


def upward(values: RunValues) -> NDArray[np.float64]:
    """Unit vector (3,) in the reference frame: a learned support's normal, else what the cameras hold level.

    People hold cameras so that the image's x axis is level: up is across all of them, on the side where
    the images have their top.
    """
    for shape in values.shapes.values():
        return shape.reference_from_grid[:3, 2]
    if values.slam is None:
        return np.array([0.0, -1.0, 0.0])
    rightward, top = values.slam.mean[:, :3, 0], -values.slam.mean[:, :3, 1].mean(axis=0)
    tilt, axes = np.linalg.eigh(rightward.T @ rightward / len(rightward))
    across = axes[:, tilt < 0.02]
    up = across @ (across.T @ top) if across.size else top
    return up / max(float(np.linalg.norm(up)), 1e-12)


def _eye(poses: NDArray[np.float64], up: NDArray[np.float64]) -> rrb.EyeControls3D:
    """Behind and above the first camera, looking where the cameras look together."""
    target = _common_target(poses)
    back = poses[0, :3, 3] - target
    reach = max(float(np.linalg.norm(poses[:, :3, 3] - target, axis=1).max()), 0.3)
    level = back - (back @ up) * up
    away = level / max(float(np.linalg.norm(level)), 1e-6)
    return rrb.EyeControls3D(
        position=target + 1.7 * reach * away + 2.0 * reach * up, look_target=target, eye_up=up
    )


def _eye_at_objects(values: RunValues, up: NDArray[np.float64]) -> rrb.EyeControls3D:
    """From where the camera was, nearer to the objects and a little higher."""
    camera = values.reference_from_parsed
    target = camera[:3, 3] + camera[:3, 2]
    if values.scene is not None and values.surfaces is not None and values.scene.found.any():
        places = found_places_m(values.scene, values.surfaces.by_name)
        target = camera[:3, 3] + camera[:3, :3] @ places.mean(axis=0)
    back = camera[:3, 3] - target
    return rrb.EyeControls3D(position=target + 0.8 * back + 0.1 * up, look_target=target, eye_up=up)


def _common_target(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """The point (3,) nearest to all optical axes, in least squares; a little inertia keeps it defined."""
    axes = poses[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    ahead = poses[:, :3, 3] + axes
    inertia = 1e-3 * len(poses)
    right = np.einsum("tij,tj->i", across, poses[:, :3, 3]) + inertia * ahead.mean(axis=0)
    return np.linalg.solve(across.sum(axis=0) + inertia * np.eye(3), right)
