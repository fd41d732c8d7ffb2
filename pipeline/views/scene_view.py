"""The parsed scene: objects where they were found, how sure that is, and what rests on what."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from pipeline.surfaces import SceneSurface
from pipeline.views.trajectory_view import ENLARGED, quaternions_xyzw
from scene.result import SceneResult

OBJECT_COLOURS = (
    *((239, 131, 84), (91, 155, 213), (130, 200, 110), (220, 180, 70)),
    *((190, 120, 210), (90, 200, 190), (230, 110, 140), (165, 165, 120)),
)
LETTER_PX, LEVEL_PX, STAGGER_PX = 8, 100, 40
"""Of the graph: width of a letter, height of a level, and by how much every second node is raised."""
LIKELY = 0.2
"""Edges at least as probable are drawn."""
TABLE_COLOUR = (150, 160, 175)
LABEL_COLOUR = (255, 255, 255)
"""Rerun writes a label in the colour of its point: on an object of the same colour nobody could read it."""
LABEL_RADIUS_M = 1e-4
CHI_95 = 2.796
"""Radius of the 95% region of a normal distribution in three dimensions, in standard deviations."""


def log_scene(
    recording: rr.RecordingStream,
    scene: SceneResult,
    surfaces: Mapping[str, SceneSurface],
    reference_from_camera: NDArray[np.float64],
) -> None:
    """Objects that were found, in the room, with the 95% regions of their positions; and the scene graph.

    Args:
        recording: where to.
        scene: what was found.
        surfaces: of the objects, by name.
        reference_from_camera: (4, 4) of the first frame that was parsed.
    """
    for one in map(int, np.flatnonzero(scene.found)):
        name, path = str(scene.names[one]), f"world/objects/{scene.names[one]}"
        pose = reference_from_camera @ scene.camera_from_object[one]
        recording.log(path, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), static=True)
        mesh = rr.Mesh3D(
            vertex_positions=surfaces[name].vertices_m,
            triangle_indices=surfaces[name].faces,
            vertex_normals=_normals(surfaces[name]),
            albedo_factor=object_colour(one),
        )
        recording.log(f"{path}/surface", mesh, static=True)
        middle = surfaces[name].middle_m
        variances, axes = np.linalg.eigh(scene.covariance_of_point(one, middle))
        axes *= np.sign(np.linalg.det(axes))
        ellipsoid = rr.Ellipsoids3D(
            centers=[middle],
            half_sizes=[ENLARGED * CHI_95 * np.sqrt(np.maximum(variances, 0))],
            quaternions=quaternions_xyzw(axes[None]),
            colors=(*object_colour(one), 110),
            fill_mode="majorwireframe",
        )
        recording.log(f"{path}/uncertainty", ellipsoid, static=True)
        label = rr.Points3D(
            [middle], radii=LABEL_RADIUS_M, colors=LABEL_COLOUR, labels=f"{name} {scene.presence[one]:.0%}"
        )
        recording.log(f"{path}/label", label, static=True)
    _log_graph(recording, scene)


def found_places_m(scene: SceneResult, surfaces: Mapping[str, SceneSurface]) -> NDArray[np.float64]:
    """Middles (F, 3) of the objects that were found, in the camera of the first frame parsed."""
    found = np.flatnonzero(scene.found)
    poses = scene.camera_from_object[found]
    middles = np.stack([surfaces[str(scene.names[one])].middle_m for one in found])
    return poses[:, :3, 3] + np.einsum("fij,fj->fi", poses[:, :3, :3], middles)


def object_colour(index: int) -> tuple[int, int, int]:
    """The colour of an object in every view."""
    return OBJECT_COLOURS[index % len(OBJECT_COLOURS)]


def _log_graph(recording: rr.RecordingStream, scene: SceneResult) -> None:
    found = np.flatnonzero(scene.found).tolist()
    names = [*map(str, scene.names), *scene.supports]
    nodes = [*found, *range(len(scene.names), len(names))]
    recording.log(
        "graph",
        rr.GraphNodes(
            [names[node] for node in nodes],
            positions=_node_places(scene, [names[node] for node in nodes]),
            labels=[names[node] for node in nodes],
            colors=[object_colour(node) for node in found] + [TABLE_COLOUR] * len(scene.supports),
        ),
        rr.GraphEdges(
            [
                (names[child], names[parent])
                for child in found
                for parent in np.flatnonzero(scene.edge_probabilities[child] >= LIKELY)
            ],
            graph_type="directed",
        ),
        static=True,
    )


def _node_places(scene: SceneResult, labels: Sequence[str]) -> NDArray[np.float64]:
    """Pixels (F + S, 2) of the nodes of what was found and of the supports, which are the last.

    Drawn as the most probable scene stands: the supports below, what rests on a thing above it. Neighbours
    alternate in height, so that they may come closer than their labels are wide.
    """
    found = np.flatnonzero(scene.found).tolist()
    supports = [len(scene.names) + number for number in range(len(scene.supports))]
    nodes = [*found, *supports]
    parents = scene.sample_parents[np.argmax(scene.sample_log_posteriors)]
    resting = {node: [one for one in found if parents[one] == node] for node in nodes}
    floating = [one for one in found if parents[one] not in nodes]
    closest = max(map(len, labels)) * LETTER_PX / 2 + LETTER_PX
    columns, raised = itertools.count(), defaultdict(lambda: itertools.cycle((0, STAGGER_PX)))
    places: dict[int, tuple[float, float]] = {}

    def place(node: int, level: int) -> float:
        above = [place(one, level + 1) for one in resting[node]]
        column = sum(above) / len(above) if above else next(columns)
        places[node] = closest * column, -LEVEL_PX * level - next(raised[level])
        return column

    for one in supports:
        place(one, 0)
    for one in floating:
        place(one, 1)
    return np.array([places[node] for node in nodes])


def _normals(surface: SceneSurface) -> NDArray[np.float64]:
    """Unit normals (V, 3) at the vertices, faces weighing by their area."""
    corners = surface.vertices_m[surface.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(surface.vertices_m)
    for corner in range(3):
        np.add.at(normals, surface.faces[:, corner], across)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
