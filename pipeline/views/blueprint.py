"""How the views of a run are arranged, and where the eye stands."""

from __future__ import annotations

import numpy as np
import rerun.blueprint as rrb
from numpy.typing import NDArray

from pipeline.colours import BACKGROUND
from pipeline.publishing.values import RunValues
from pipeline.room import RoomView
from pipeline.views.framing import Eye, chosen_eye, eye_before
from pipeline.views.scene_view import found_places_m, graph_bounds, object_path
from pipeline.views.timelines import ELAPSED
from pipeline.views.trajectory_view import PLOTS
from pipeline.views.truth_view import ERROR_PLOT
from shapes.geometry.poses import transform_points
from shapes.prior import ShapePrior

ROOM_VIEW = "Room"
SHAPE_FROM = np.array([0.75, -0.65, 0.55])
"""Side of a learned shape from which it is looked at, its support below."""


def run_blueprint(values: RunValues, eye: Eye | None, *, truth: bool = False) -> rrb.Blueprint:
    """The room large on the left; what the camera saw, shapes, graph, plots and the report on the right.

    Args:
        values: of the run.
        eye: on the room; None where there is nothing to see in it.
        truth: is shown beside them.
    """
    rows: list[tuple[float, rrb.ContainerLike]] = []
    if values.room is not None:
        lines = sum((1, values.room.has_depth, values.slam is not None, truth, bool(values.shapes)))
        rows += [(2.6, _images(values.room)), (0.5 + 0.33 * lines, _picture("legend", "Colours"))]
    if values.shapes:
        rows.append((3.8, rrb.Tabs(*(_shape_view(name, values) for name in values.shapes))))
    if values.scene is not None:
        across, down = graph_bounds(values.scene).T.tolist()
        graph = rrb.GraphView(
            origin="graph",
            name="What rests on what",
            visual_bounds=rrb.VisualBounds2D(x_range=across, y_range=down),
        )
        rows.append((2.8, rrb.Horizontal(graph, _picture("presence", "Presence"))))
    if values.slam is not None:
        rows.append((4.0 if truth else 2.7, _plots(truth=truth)))
    if truth:
        rows.append((2.4, _picture("calibration", "How much of the truth lies in the reported regions")))
    rows.append((3.4, rrb.TextDocumentView(origin="report", name="Report")))
    side = rrb.Vertical(*(row for _, row in rows), row_shares=[share for share, _ in rows])
    return rrb.Blueprint(
        rrb.Horizontal(_room_view(values, eye), side, column_shares=[5, 4]) if eye is not None else side,
        rrb.TimePanel(state="collapsed", timeline=ELAPSED),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _images(room: RoomView) -> rrb.Horizontal:
    names = {"depth": "Seen", "rendered": "Rendered", "difference": "Residual"}
    if not room.has_depth:
        names = {"rendered": "Rendered"}
    if room.view_rgb is not None:
        names["colour"] = "Colour"
    return rrb.Horizontal(*(_picture(f"images/{path}", title) for path, title in names.items()))


def _picture(path: str, name: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(origin=path, name=name, background=BACKGROUND)


def _plots(*, truth: bool) -> rrb.Grid:
    """How sure the filter was, over the seconds, and how wrong."""
    named = {f"plots/{path}": title for path, (title, _) in PLOTS.items()}
    if truth:
        named = dict([ERROR_PLOT]) | named
    plots = [
        rrb.TimeSeriesView(origin=path, name=title, plot_legend=rrb.PlotLegend(visible=False))
        for path, title in named.items()
    ]
    return rrb.Grid(*plots, grid_columns=2)


def _room_view(values: RunValues, eye: Eye) -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin="world",
        contents="world/**",
        name=ROOM_VIEW,
        eye_controls=_controls(eye),
        line_grid=False,
        background=BACKGROUND,
        overrides={path: rrb.EntityBehavior(visible=False) for path in _switched_off(values)},
    )


def _switched_off(values: RunValues) -> list[str]:
    """What is there to be switched on: enlarged ellipsoids, of which true ones stand beside."""
    paths = ["world/path/uncertainty_10x"] if values.slam is not None else []
    if values.scene is not None:
        names = [name for name, _ in values.scene.found_poses]
        paths += [f"{object_path(name)}/uncertainty_10x" for name in names]
    return paths


def room_eye(values: RunValues) -> Eye | None:
    """On the objects that were found, on what was learned, else on the room; the path in sight.

    None where there is nothing to look at.
    """
    cloud = np.zeros((0, 3)) if values.room is None else values.room.points_m
    path = np.zeros((0, 3)) if values.slam is None else values.slam.mean[:, :3, 3]
    first_camera, wanted, focus = np.eye(4), path, None
    if values.scene is not None and values.surfaces is not None and values.scene.found.any():
        first_camera = values.reference_from_parsed
        corners = found_places_m(values.scene, values.surfaces, first_camera[:3, :3].T @ values.up)
        focus = transform_points(first_camera, corners)
        cloud = cloud if len(cloud) else _inside(focus)
        wanted = np.concatenate([focus, path])
    elif values.shapes:
        focus = np.concatenate([_posed_box(values, name) for name in values.shapes])
        wanted = np.concatenate([focus, path])
    if not len(cloud) and not len(wanted):
        return None
    return chosen_eye(cloud, wanted, first_camera, values.up, focus)


def _inside(places_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (F * 648, 3) between the places (F * 9, 3) of objects: what fills the picture without depth."""
    nine = places_m.reshape(-1, 9, 1, 1, 3)
    share = np.linspace(0, 1, 8)[:, None]
    return (share * nine + (1 - share) * nine.swapaxes(1, 2)).reshape(-1, 3)


def _posed_box(values: RunValues, name: str) -> NDArray[np.float64]:
    """Corners (8, 3) of a learned shape's box in the reference frame."""
    shape = values.shapes[name]
    corners = np.stack(np.meshgrid(*_box_m(shape).T), axis=-1).reshape(-1, 3)
    return transform_points(shape.reference_from_grid, corners)


def _box_m(shape: ShapePrior) -> NDArray[np.float64]:
    """Corners (2, 3) of what is solid of a shape, or of all of its grid where nothing is."""
    whole = np.array([np.zeros(3), shape.phi.shape]) * shape.pitch_m
    return shape.bounding_box_m if shape.solid.any() else whole


def _shape_view(name: str, values: RunValues) -> rrb.Spatial3DView:
    """A learned shape in a space of its own: by state, as voxels where that is switched on."""
    shape = values.shapes[name]
    shown = shape.solid if shape.solid.any() else np.ones(shape.phi.shape, np.bool_)
    voxels_m, toward = (np.argwhere(shown) + 0.5) * shape.pitch_m, SHAPE_FROM / np.linalg.norm(SHAPE_FROM)
    eye = eye_before(voxels_m, toward, np.array([0.0, 0.0, 1.0]))
    return rrb.Spatial3DView(
        origin=f"shapes/{name}",
        name=name,
        eye_controls=_controls(eye),
        line_grid=False,
        background=BACKGROUND,
        overrides={f"shapes/{name}/voxels": rrb.EntityBehavior(visible=False)},
    )


def _controls(eye: Eye) -> rrb.EyeControls3D:
    return rrb.EyeControls3D(position=eye.position, look_target=eye.target, eye_up=eye.up)
